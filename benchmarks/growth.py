"""How the cost of a step grows: with rays, samples and incident directions in proportion, with views not at all.

    python -m benchmarks.growth --out docs

Each panel has the CPU time of a joint step over one number, the others held at those of a small step of the paper's hash-grid
setting; views share one number of pixels drawn. A slope of 1 in the logarithms is growth in proportion.
"""

from __future__ import annotations

import dataclasses
import math
import statistics
import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import torch
import tyro
from rich.console import Console

from benchmarks.charts import Chart, Line, draw_charts
from benchmarks.joint import fitted_model, rays_at_the_table, step_on
from benchmarks.measure import hardware
from neilfpp_method.config import NeilfConfig
from neilfpp_method.data.capture import load_capture
from neilfpp_method.data.pixels import PixelDataset
from neilfpp_method.demo import demo_scene
from neilfpp_method.kernels.process import computing_fast
from neilfpp_method.presets import free_light, preset
from neilfpp_method.train.loop import seed_step

__all__ = ["Growth", "slope"]

RAYS = (64, 128, 256, 512, 1024)
SAMPLES = (16, 32, 64, 128, 256)
DIRECTIONS = (16, 32, 64, 128, 256)
VIEWS = (1, 2, 4, 8, 16)
STEPS = 3
DRAWS = 50


@dataclass
class Options:
    """Measure the growth of a step's cost and draw it."""

    out: Path = Path("runs/benchmarks")
    """Where the figure and the table go."""


@dataclass(frozen=True)
class Growth:
    """Seconds of CPU time over a number."""

    name: str
    numbers: tuple[int, ...]
    seconds: tuple[float, ...]


def slope(growth: Growth) -> float:
    """The slope between the last two points in logarithms: 1 is growth in proportion, 0 none."""
    (a, b), (s, t) = growth.numbers[-2:], growth.seconds[-2:]
    return math.log(t / s) / math.log(b / a)


def cpu_seconds(function: Callable[[], object]) -> float:
    """The median CPU time of a call, after one that does not count."""
    function()
    taken = []
    for number in range(STEPS):
        seed_step(0, number)
        began = time.process_time()
        function()
        taken.append(time.process_time() - began)
    return statistics.median(taken)


def step_seconds(config: NeilfConfig, rays: int) -> float:
    """Of a joint step."""
    return cpu_seconds(step_on(fitted_model(config), rays_at_the_table(rays)))


def measure() -> list[Growth]:
    """Every panel."""
    base = free_light(preset("fast"))
    replace = dataclasses.replace
    by_rays = tuple(step_seconds(base, count) for count in RAYS)
    by_samples = tuple(step_seconds(replace(base, volume=replace(base.volume, samples=n)), 256) for n in SAMPLES)
    by_directions = tuple(
        step_seconds(replace(base, shading=replace(base.shading, train_samples=n)), 256) for n in DIRECTIONS
    )
    capture = load_capture(demo_scene())
    by_views = []
    for count in VIEWS:
        pixels = PixelDataset(capture, (capture.train_views * count)[:count])
        by_views.append(cpu_seconds(lambda pixels=pixels: [pixels.sample(4096) for _ in range(DRAWS)]) / DRAWS)
    return [
        Growth("a joint step over rays", RAYS, by_rays),
        Growth("a joint step over samples of a ray", SAMPLES, by_samples),
        Growth("a joint step over incident directions", DIRECTIONS, by_directions),
        Growth("drawing a batch over views", VIEWS, tuple(by_views)),
    ]


def table(growths: list[Growth]) -> str:
    """Markdown: milliseconds, and the slope at the end."""
    lines = []
    for growth in growths:
        lines += ["| " + " | ".join([growth.name, *map(str, growth.numbers), "slope at the end"]) + " |"]
        lines += ["|---" * (len(growth.numbers) + 2) + "|"]
        cells = [f"{1e3 * seconds:.3g} ms" for seconds in growth.seconds]
        lines += ["| " + " | ".join(["CPU time", *cells, f"{slope(growth):.2f}"]) + " |", ""]
    return "\n".join(lines)


def main(options: Options) -> None:
    """Measure, print the table, write it and the figure."""
    options.out.mkdir(parents=True, exist_ok=True)
    with computing_fast():
        growths = measure()
    text = f"{hardware()}\n\n{table(growths)}"
    (options.out / "cost_growth.md").write_text(text)
    charts = [Chart(growth.name, {"CPU time": Line(growth.numbers, growth.seconds)}) for growth in growths]
    draw_charts(options.out / "cost_growth.png", "How the cost of a step grows", "number", "seconds", charts, columns=2)
    Console().print(text, markup=False, highlight=False, soft_wrap=True)


if __name__ == "__main__":
    torch.manual_seed(0)
    main(tyro.cli(Options))
