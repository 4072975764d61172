"""Cost of a whole joint step, in the package and in the plain implementation.

    python -m benchmarks joint

A step has 256 rays, all of which hit the object, with 128 incident directions each for the paper's networks.
The scene is a table with two balls. Each geometry is fitted to it first, so that rays converge and traced
rays hit, as during a training. The implementations alternate in one process. A figure is the median CPU time
of the process (wall-clock time on a GPU), or the median ratio to the plain implementation in the same round.
The plain implementation runs twice: with the default settings of a process, and with those of the commands
(`kernels.process`).
"""

from __future__ import annotations

import dataclasses
import math
import statistics
from collections.abc import Callable, Iterator, Mapping
from contextlib import nullcontext

import torch
from jaxtyping import Float
from torch import Tensor
from torch.nn.functional import normalize

from benchmarks.measure import Measurement, clock, device
from benchmarks.straightforward import straightforward
from neilfpp_method.fields.sdf import SdfField
from neilfpp_method.hosts.volsdf import VolSdfHost
from neilfpp_method.kernels.process import computing_fast
from neilfpp_method.model import NeilfModel
from neilfpp_method.schedule import Stage, active_losses, weigh
from neilfpp_method.settings.facts import SceneFacts
from neilfpp_method.settings.plain import changed
from neilfpp_method.settings.presets import preset
from neilfpp_method.settings.types import NeilfConfig
from neilfpp_method.structures import PixelBatch
from neilfpp_method.train.optimizer import make_optimizer, seed_step
from neilfpp_method.volume.partition import sample_counts

__all__ = ["cheap_paper", "fitted_model", "measurements", "rays_at_the_table", "step_on", "table"]

RAYS = 256
REPETITIONS = 5
SHARP = 3e-3  # β of a surface that counts as trained, scene units
FIT_STEPS, FIT_POINTS = 300, 1024
BALLS = (((0.2, 0.1, 0.0), 0.35), ((-0.45, 0.0, -0.1), 0.25))  # centre and radius


def table(x: Float[Tensor, "P 3"]) -> Float[Tensor, " P"]:
    """Signed distance, except at the edges, of a round table top with two balls on it."""
    balls = [(x - x.new_tensor(center)).norm(dim=-1) - radius for center, radius in BALLS]
    top = torch.maximum((x[:, 2] + 0.4).abs() - 0.05, x[:, :2].norm(dim=-1) - 0.95)
    return torch.stack([*balls, top]).amin(0)


def fit_table(field: SdfField) -> None:
    """Fit a distance field, which is initially a sphere, to the table."""
    optimizer = torch.optim.Adam(field.parameters(), lr=2e-3)
    for _ in range(FIT_STEPS):
        x = torch.rand(FIT_POINTS, 3) * 2.4 - 1.2
        sample = field.with_gradient(x)
        unit = (sample.gradient.square().sum(-1) + 1e-12).sqrt()
        loss = (sample.distance - table(x)).abs().mean() + 0.05 * (unit - 1.0).abs().mean()
        optimizer.zero_grad()
        loss.backward()
        optimizer.step()


def fitted_model(config: NeilfConfig, like: VolSdfHost | None = None) -> NeilfModel:
    """A model with the table as a sharp surface, by a fit or copied from another host with the same
    networks.
    """
    config = changed(config, {"host.loss.point_cloud": 0.0, "host.volume.beta_init": SHARP})
    torch.manual_seed(0)
    facts = SceneFacts("linear", 0.2, 3.0, "constant")
    host = VolSdfHost(config, facts)
    if like is None:
        fit_table(host.sdf_field)
    else:
        host.sdf_field.load_state_dict(like.sdf_field.state_dict())
    return NeilfModel(host, config, facts).to(device())


def rays_at_the_table(count: int) -> PixelBatch:
    """Rays from a ring of cameras towards points on the table and the balls; grey pixels."""
    generator = torch.Generator().manual_seed(1)
    turn = 2 * math.pi * torch.rand(16 * count, generator=generator)
    origins = torch.stack([2.0 * turn.cos(), 2.0 * turn.sin(), torch.full_like(turn, 1.2)], -1)
    directions = normalize(torch.rand(16 * count, 3, generator=generator) * 1.4 - 0.7 - origins, dim=-1)
    depth = torch.zeros(16 * count)
    for _ in range(100):
        depth += table(origins + depth[:, None] * directions).clamp_min(0.0)
    rows = torch.nonzero(table(origins + depth[:, None] * directions).abs() < 1e-3)[:count, 0]
    flat = torch.zeros(count)
    gray = torch.full((count, 3), 0.2)
    return PixelBatch(origins[rows], directions[rows], gray, flat + 1.0, flat, flat, flat.long()).to(device())


def step_on(model: NeilfModel, batch: PixelBatch) -> Callable[[], None]:
    """A joint step on a batch; the learning rates are 0, so all steps are equal except for their random
    numbers.
    """
    weights = active_losses(Stage.JOINT, model.config, model.stages)
    optimizer = make_optimizer(model, model.config.optimizer)
    for group in optimizer.param_groups:
        group["lr"] = 0.0
    model.train().freeze_for(Stage.JOINT)

    def step() -> None:
        optimizer.zero_grad(set_to_none=True)
        loss = weigh(model.losses(batch, Stage.JOINT), weights).loss
        loss.backward()
        optimizer.step()

    return step


def cheap_paper() -> NeilfConfig:
    """The networks of `paper-mlp` with skipping of empty space."""
    return changed(preset("paper-mlp"), {"host.volume.skip_empty": True})


def seconds_of(steps: Mapping[str, Callable[[], None]], fast: Mapping[str, bool]) -> dict[str, list[float]]:
    """The times of each step; the steps alternate. Each timed step follows another one of its kind that is
    not counted, because in a training the memory and the settings of the previous step are in place.
    """
    now = clock(device())
    taken: dict[str, list[float]] = {name: [] for name in steps}
    for number in range(REPETITIONS):
        for name, step in steps.items():
            with computing_fast() if fast[name] else nullcontext():
                for _ in range(2):
                    seed_step(0, number)
                    began = now()
                    step()
                    last = now() - began
            taken[name].append(last)
    return taken


def measurements() -> Iterator[Measurement]:
    """Ratios of whole steps."""
    batch = rays_at_the_table(RAYS)
    with computing_fast():
        cheap, fast = fitted_model(cheap_paper()), fitted_model(preset("fast"))
        published = fitted_model(preset("paper-mlp"), like=cheap.host)
    plain = straightforward(cheap).to(device())
    # Half as many cuts as in the paper, and half of these on the rest of a ray that skips empty space
    # (`benchmarks.sampler` measures the error of that).
    paper = sample_counts(preset("paper-mlp").host.volume)
    cheap.host.sample_counts = plain.host.sample_counts = dataclasses.replace(paper, cuts=paper.cuts // 2)
    steps = {
        "plain": step_on(plain, batch),
        "plain, settings of the process": step_on(plain, batch),
        "paper-mlp": step_on(published, batch),
        "paper-mlp, made cheap": step_on(cheap, batch),
        "fast": step_on(fast, batch),
    }
    seconds = seconds_of(steps, {name: name != "plain" for name in steps})
    plain_seconds = seconds.pop("plain")
    yield Measurement("joint/plain", statistics.median(plain_seconds), "s", "lower")
    for name, taken in seconds.items():
        # The speed of a machine varies, so ratios are taken within a round.
        ratio = statistics.median(slow / own for slow, own in zip(plain_seconds, taken, strict=True))
        yield Measurement(f"joint/plain over {name}", ratio, "×", "higher", tolerance=0.5)
