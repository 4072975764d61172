"""Quality of novel views and of the material over training time, for every preset.

    python -m benchmarks.time_to_quality DATA/tabletop_mix --out docs
    python -m benchmarks.time_to_quality DATA/tabletop_mix --presets paper-ngp --out docs \
        --device cuda --cap 600

Each preset trains from scratch. Its test views are measured at times of which each is twice the one before
(CPU time of the process; on a GPU, wall-clock time); the measurements themselves do not count. `fast` runs to
its end. A preset that is stopped by `--cap` is marked as unfinished, with the step that it reached: its
learning rates have not decreased yet, and its material may not have been trained.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path

import torch
import tyro
from rich.console import Console

from benchmarks.charts import Chart, Line, draw_charts
from benchmarks.command import run_benchmark
from benchmarks.measure import clock, hardware
from neilfpp_method.data.capture import load_capture
from neilfpp_method.data.pixels.dataset import PixelDataset
from neilfpp_method.evaluate.map_metrics import image_metrics, material_metrics
from neilfpp_method.evaluate.views import known_test_views, render_test_views
from neilfpp_method.kernels.process import computing_fast
from neilfpp_method.model import NeilfModel
from neilfpp_method.schedule import active_losses, stage_at, stage_steps, weigh
from neilfpp_method.settings.plain import changed
from neilfpp_method.settings.presets import preset
from neilfpp_method.settings.types import NeilfConfig
from neilfpp_method.train.build import build_model, scene_facts
from neilfpp_method.train.device import pick_device
from neilfpp_method.train.optimizer import (
    Stream,
    make_optimizer,
    seed_step,
    seed_stream,
    set_rates,
    waiting_fields,
)
from neilfpp_method.train.run import Run

__all__ = ["Curve", "Mark", "curve", "table"]

FIGURES = {
    "volume_psnr": "novel view, R",
    "pbr_psnr": "novel view, PBR",
    "base_color_psnr_scaled": "base colour, scaled",
    "roughness_psnr": "roughness",
    "metallic_psnr": "metallic",
}


@dataclass
class Options:
    """Train presets on captures with known truth, and measure them during the training."""

    captures: tyro.conf.Positional[tuple[Path, ...]]
    """Folders of captures."""
    presets: tuple[str, ...] = ("fast", "paper-ngp", "paper-mlp")
    """Names of presets."""
    cap: float = 3600.0
    """Seconds after which a preset is stopped, except `fast`."""
    first: float = 15.0
    """Seconds until the first measurement."""
    views: int = 2
    """Number of test views that are rendered for a measurement."""
    device: str = "auto"
    """Device to train on."""
    out: Path = Path("runs/benchmarks")
    """Folder for the figure and the table."""


@dataclass(frozen=True)
class Mark:
    """A measurement after so many seconds of training."""

    seconds: float
    step: int
    figures: Mapping[str, float]


@dataclass(frozen=True)
class Curve:
    """The measurements of a preset, and the number of steps of its complete training."""

    marks: tuple[Mark, ...]
    steps: int

    @property
    def finished(self) -> bool:
        return self.marks[-1].step == self.steps

    def line(self, figure: str) -> Line | None:
        """A figure over seconds, from its first measurement on."""
        known = [(mark.seconds, mark.figures[figure]) for mark in self.marks if figure in mark.figures]
        return Line(*zip(*known, strict=True)) if known else None


def curve(
    root: Path, config: NeilfConfig, cap: float, first: float, views: int, device: torch.device
) -> Curve:
    """Train a preset until its end or the time limit, and measure it at the marks and at the end."""
    capture = load_capture(root)
    pixels = PixelDataset(capture, capture.train_views, device=device)
    facts = scene_facts(capture, pixels, config)
    seed_stream(config.train.seed, Stream.WEIGHTS)
    model = build_model(capture, facts, config).to(device)
    shown = dataclasses.replace(capture, test=frozenset(view.name for view in capture.test_views[:views]))
    steps = sum(stage_steps(config.train).values())
    marks, due, seconds = [], first, 0.0
    for step, taken in _training(model, pixels, config, device):
        seconds += taken
        last = step == steps or seconds >= cap
        if seconds >= due or last:
            marks.append(Mark(seconds, step, _measure(Run(root, config, shown, facts, model.eval(), step))))
            model.train()
            due *= 2
        if last:
            break
    return Curve(tuple(marks), steps)


def _training(
    model: NeilfModel, pixels: PixelDataset, config: NeilfConfig, device: torch.device
) -> Iterator[tuple[int, float]]:
    """The steps of all stages as `train.loop` takes them, with nothing kept: how many are done, and the last
    one's seconds.
    """
    now = clock(device)
    optimizer, solver = make_optimizer(model, config.optimizer), model.light_solver().to(device)
    for step in range(sum(stage_steps(config.train).values())):
        began = now()
        position = stage_at(step, config.train)
        if position.step == 0:
            model.train().freeze_for(position.stage)
        seed_step(config.train.seed, step)
        set_rates(optimizer, config.optimizer, position, waiting_fields(model, config.optimizer, position))
        optimizer.zero_grad(set_to_none=True)
        computed = model.step(pixels.sample(config.train.rays), position.stage)
        weigh(
            computed.terms, active_losses(position.stage, config, model.stages, position.share)
        ).loss.backward()
        optimizer.step()
        solver.observe(computed)
        solver.solve(model.brdf, model.scene)
        yield step + 1, now() - began


def _measure(run: Run) -> dict[str, float]:
    rendered = render_test_views(run)
    pairs = list(zip(rendered, known_test_views(run, rendered).views, strict=True))
    figures = image_metrics(run, pairs) | material_metrics(run, pairs)
    return {name: figures[name] for name in FIGURES if name in figures}


def table(curves: Mapping[str, Curve]) -> str:
    """Markdown: a row for each mark."""
    lines = [
        "| preset | seconds | step | " + " | ".join(FIGURES.values()) + " |",
        "|---" * (3 + len(FIGURES)) + "|",
    ]
    for name, measured in curves.items():
        for mark in measured.marks:
            cells = [f"{mark.figures[figure]:.2f}" if figure in mark.figures else "–" for figure in FIGURES]
            lines.append(
                "| "
                + " | ".join([name, f"{mark.seconds:.0f}", f"{mark.step} of {measured.steps}", *cells])
                + " |"
            )
    return "\n".join(lines)


def charts(capture: Path, curves: Mapping[str, Curve]) -> list[Chart]:
    """A panel for each figure; the names of unfinished curves say so."""
    titled = {name if c.finished else f"{name}, unfinished": c for name, c in curves.items()}
    lines = {figure: {name: c.line(figure) for name, c in titled.items()} for figure in FIGURES}
    panels = {figure: {name: line for name, line in found.items() if line} for figure, found in lines.items()}
    return [Chart(f"{capture.name}: {FIGURES[figure]}", found) for figure, found in panels.items() if found]


def main(options: Options) -> None:
    """Train, print the tables, write them and the figure."""
    options.out.mkdir(parents=True, exist_ok=True)
    device = pick_device(options.device)
    sections, panels = [hardware()], []
    with computing_fast():
        for capture in options.captures:
            curves = {}
            for name in options.presets:
                cap = float("inf") if name == "fast" else options.cap
                # The clouds of captures with known truth are of the true surface, which is to be found.
                config = changed(preset(name), {"host.loss.point_cloud": 0.0})
                curves[name] = curve(capture, config, cap, options.first, options.views, device)
                Console().print(table({name: curves[name]}), markup=False, highlight=False, soft_wrap=True)
            sections.append(f"### {capture.name}\n\n{table(curves)}")
            panels += charts(capture, curves)
    (options.out / "time_to_quality.md").write_text("\n\n".join(sections) + "\n")
    title = "What training time buys"
    draw_charts(
        options.out / "time_to_quality.png", title, "seconds of training", "PSNR, dB", panels, columns=2
    )


if __name__ == "__main__":
    run_benchmark(lambda: main(tyro.cli(Options)))
