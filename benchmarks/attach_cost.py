"""Cost of an attached NeILF++ while no material stage runs: a host's own step with and without it.

    python -m benchmarks.attach_cost

The host is VolSDF, trained by its own loop and borrowed. Steps of the two loops alternate, so that other work
on the machine affects both equally. The medians of both and their ratio are printed.
"""

from __future__ import annotations

import statistics
import time
from collections.abc import Callable

import torch
from torch.nn.functional import normalize

from neilfpp_method.attach import attach_neilf, pixel_batch
from neilfpp_method.hosts.volsdf import VolSdfHost
from neilfpp_method.settings.facts import SceneFacts
from neilfpp_method.settings.presets import preset
from neilfpp_method.structures import PixelBatch, RayBatch

STEPS = 100


class Borrowed:
    """A host that offers only `render`; the loop below trains its parameters."""

    def __init__(self, host: VolSdfHost) -> None:
        self.render = host.render


def batch_of(count: int) -> PixelBatch:
    """Rays from all sides towards the origin."""
    origins = 3.0 * normalize(torch.randn(count, 3), dim=-1)
    directions = normalize(0.3 * torch.randn(count, 3) - origins, dim=-1)
    return pixel_batch(origins, directions, torch.full((count, 3), 0.3))


def loop(attached: bool) -> Callable[[PixelBatch, int], None]:
    """A training step of the host, with or without the add-on's losses in it."""
    torch.manual_seed(0)
    config = preset("fast")
    host = VolSdfHost(config, SceneFacts("linear", 0.2, 3.0, "constant"))
    optimizer = torch.optim.Adam(host.parameters(), lr=1e-3)
    neilf = attach_neilf(Borrowed(host), config) if attached else None

    def step(batch: PixelBatch, number: int) -> None:
        loss = (host.render(RayBatch(batch.origins, batch.directions)).color - batch.color).abs().mean()
        if neilf is not None:
            loss = loss + neilf.losses(batch, number).loss
        optimizer.zero_grad()
        loss.backward()
        optimizer.step()

    return step


def main() -> None:
    """Measure and print."""
    loops = {"host alone": loop(attached=False), "with NeILF++ attached": loop(attached=True)}
    seconds: dict[str, list[float]] = {name: [] for name in loops}
    for number in range(STEPS):
        batch = batch_of(256)
        # The second loop would profit from the caches of the first, so the order alternates.
        for name, step in sorted(loops.items(), reverse=number % 2 == 1):
            torch.manual_seed(number)  # the same samples along the rays, so the same work
            started = time.perf_counter()
            step(batch, number)
            seconds[name].append(time.perf_counter() - started)
    medians = {name: statistics.median(values[5:]) for name, values in seconds.items()}
    for name, median in medians.items():
        print(f"{name:24} {1e3 * median:8.2f} ms a step")
    alone, attached = medians.values()
    print(
        f"{'ratio':24} {attached / alone:8.3f}   ({torch.get_num_threads()} threads, 256 rays, {STEPS} steps "
        "each)"
    )


if __name__ == "__main__":
    main()
