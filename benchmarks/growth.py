"""Growth of the cost of a step: in proportion to rays, samples and incident directions, and independent of
views.

    python -m benchmarks.growth --out docs

Each panel has the CPU time of a joint step of `fast` with the free light as a function of one number, with
the others fixed, for rays that all hit the table of `benchmarks.joint`. The last panel has the time of
drawing 4096 pixels from so many views. For each panel, the written table has a straight line, which consists
of a fixed and a proportional part, and the largest deviation from it.
"""

from __future__ import annotations

import dataclasses
import statistics
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch
import tyro
from rich.console import Console

from benchmarks.charts import Chart, Line, draw_charts
from benchmarks.joint import fitted_model, rays_at_the_table, step_on
from benchmarks.measure import clock, device, hardware
from neilfpp_method.data.capture import load_capture
from neilfpp_method.data.pixels.dataset import PixelDataset
from neilfpp_method.demo.command import demo_scene
from neilfpp_method.kernels.process import computing_fast
from neilfpp_method.model import NeilfModel
from neilfpp_method.settings.plain import changed
from neilfpp_method.settings.presets import free_light, preset
from neilfpp_method.settings.types import NeilfConfig
from neilfpp_method.train.optimizer import seed_step
from neilfpp_method.volume.partition import sample_counts

__all__ = ["Growth", "StraightLine", "straight_line"]

RAYS = (64, 128, 256, 512, 1024)
SAMPLES = (16, 32, 64, 128, 256)
DIRECTIONS = (16, 32, 64, 128, 256)
SMALL = 256  # rays of the panels that are not about rays
VIEWS = (1, 2, 4, 8, 16)
STEPS = 5
DRAWS = 50


@dataclass
class Options:
    """Measure the growth of a step's cost and draw it."""

    out: Path = Path("runs/benchmarks")
    """Folder for the figure and the table."""


@dataclass(frozen=True)
class Growth:
    """CPU seconds as a function of a number."""

    name: str
    numbers: tuple[int, ...]
    seconds: tuple[float, ...]


@dataclass(frozen=True)
class StraightLine:
    """seconds = fixed + each · number, and the largest relative deviation of a figure from it."""

    fixed: float
    each: float
    off: float


def straight_line(growth: Growth) -> StraightLine:
    """Fit the line by least squares of relative deviations."""
    numbers, seconds = np.array(growth.numbers, dtype=float), np.array(growth.seconds)
    each, fixed = np.polyfit(numbers, seconds, 1, w=1 / seconds)
    return StraightLine(
        float(fixed), float(each), float(np.abs((fixed + each * numbers) / seconds - 1).max())
    )


def seconds_of(function: Callable[[], object]) -> float:
    """Median time of a call, after one call that is not counted."""
    function()
    now, taken = clock(device()), []
    for number in range(STEPS):
        seed_step(0, number)
        began = now()
        function()
        taken.append(now() - began)
    return statistics.median(taken)


def step_seconds(model: NeilfModel, config: NeilfConfig, rays: int) -> float:
    """CPU time of a joint step with settings other than those of the model; they must not change a
    network.
    """
    model.config = model.host.config = config
    model.host.sample_counts = sample_counts(config.host.volume)
    return seconds_of(step_on(model, rays_at_the_table(rays)))


def measure() -> list[Growth]:
    """Measure all panels."""
    base = free_light(preset("fast"))
    model, replace = fitted_model(base), dataclasses.replace
    base = model.config
    by_rays = tuple(step_seconds(model, base, count) for count in RAYS)
    with_samples = [changed(base, {"host.volume.samples": n}) for n in SAMPLES]
    by_samples = tuple(step_seconds(model, config, SMALL) for config in with_samples)
    with_directions = [replace(base, shading=replace(base.shading, train_samples=n)) for n in DIRECTIONS]
    by_directions = tuple(step_seconds(model, config, SMALL) for config in with_directions)
    capture = load_capture(demo_scene())
    by_views = []
    for count in VIEWS:
        pixels = PixelDataset(capture, capture.train_views[:count], device=device())
        by_views.append(seconds_of(lambda pixels=pixels: [pixels.sample(4096) for _ in range(DRAWS)]) / DRAWS)
    return [
        Growth("a joint step over rays", RAYS, by_rays),
        Growth("a joint step over samples of a ray", SAMPLES, by_samples),
        Growth("a joint step over incident directions", DIRECTIONS, by_directions),
        Growth("drawing a batch over views", VIEWS, tuple(by_views)),
    ]


def table(growths: list[Growth]) -> str:
    """Markdown: milliseconds, and the straight line that is fitted to them."""
    lines = []
    for growth in growths:
        line = straight_line(growth)
        lines += [
            "| " + " | ".join([growth.name, *map(str, growth.numbers), "straight line", "off it"]) + " |"
        ]
        lines += ["|---" * (len(growth.numbers) + 3) + "|"]
        cells = [f"{1e3 * seconds:.3g} ms" for seconds in growth.seconds]
        fitted = f"{1e3 * line.fixed:.3g} ms + {1e3 * line.each:.2g} ms each"
        lines += ["| " + " | ".join(["CPU time", *cells, fitted, f"{100 * line.off:.0f} %"]) + " |", ""]
    return "\n".join(lines)


def main(options: Options) -> None:
    """Measure, print the table, write it and the figure."""
    options.out.mkdir(parents=True, exist_ok=True)
    with computing_fast():
        growths = measure()
    text = f"{hardware()}\n\n{table(growths)}"
    (options.out / "cost_growth.md").write_text(text)
    charts = [Chart(growth.name, {"CPU time": Line(growth.numbers, growth.seconds)}) for growth in growths]
    draw_charts(
        options.out / "cost_growth.png",
        "How the cost of a step grows",
        "number",
        "seconds",
        charts,
        columns=2,
    )
    Console().print(text, markup=False, highlight=False, soft_wrap=True)


if __name__ == "__main__":
    torch.manual_seed(0)
    main(tyro.cli(Options))
