"""`neilfpp train`: from a capture's folder to a finished run."""

from __future__ import annotations

import os
import signal
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import torch
from lightning_fabric import Fabric
from lightning_fabric.strategies import DDPStrategy
from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn

from neilfpp_method.config import NeilfConfig
from neilfpp_method.data.capture import Capture
from neilfpp_method.data.pixels import PixelDataset
from neilfpp_method.errors import UserError
from neilfpp_method.model import NeilfModel
from neilfpp_method.schedule import Stage, stage_steps
from neilfpp_method.train.build import build_model, scene_facts
from neilfpp_method.train.device import pick_device
from neilfpp_method.train.loop import Training, seed_step, train
from neilfpp_method.train.preview import write_preview
from neilfpp_method.train.progress import Reporter, reporting
from neilfpp_method.train.run import CaptureSource, create_run, read_description

__all__ = ["run_training"]


def run_training(
    *,
    data: Path | None,
    out: Path | None,
    config: NeilfConfig,
    resume: bool,
    test_every: int | None,
    response: str,
    device: str,
    devices: int,
    console: Console,
) -> Path:
    """Train a run to its end and return its folder.

    Raises:
        UserError: bad input.
        Stopped: a person asked for it; names the command that continues.
        Diverged: see `train.loop.train`.
    """
    fabric = _launch(device, devices)
    if resume:
        if out is None:
            raise UserError("--resume needs the run's folder", "give it with --out RUN")
        described = read_description(out)
        config, source = described.config, described.source
        capture, facts = source.load(), described.facts
        pixels = _load_pixels(capture, fabric, console)
    else:
        if data is None:
            raise UserError("no capture given", "name its folder with --data DIR")
        _check(config)
        source = CaptureSource(str(data.resolve()), test_every, response)
        capture = source.load()
        pixels = _load_pixels(capture, fabric, console)
        facts = scene_facts(capture, pixels, config)
        out = out or Path("runs") / f"{data.resolve().name}-{config.preset}"
    seed_step(config.train.seed, step=-1)
    model = build_model(capture, facts, config)
    if not resume and fabric.is_global_zero:
        create_run(out, config, source, facts)
    fabric.barrier()
    if fabric.is_global_zero:
        console.print(capture.summary, highlight=False)
        console.print(f"run folder {out}", highlight=False)
    with reporting(out, console, fabric.is_global_zero) as reporter, _stop_request() as stopped:
        train(Training(out, config, model, pixels, fabric, reporter, stopped, _preview(out, capture, fabric, reporter)))
    return out


def _launch(device: str, devices: int) -> Fabric:
    place = pick_device(device)
    strategy = DDPStrategy(find_unused_parameters=True) if devices > 1 else "auto"
    chosen = [place.index] if place.index is not None and devices == 1 else devices
    fabric = Fabric(accelerator=place.type, devices=chosen, strategy=strategy)
    fabric.launch()
    return fabric


def _check(config: NeilfConfig) -> None:
    if min(stage_steps(config.train).values()) < 0 or sum(stage_steps(config.train).values()) == 0:
        raise UserError("the stages have no steps", "set --config.train.sdf-steps and the others to 0 or more")
    if config.train.rays < 1:
        raise UserError("a step needs rays", "set --config.train.rays to 1 or more")


def _load_pixels(capture: Capture, fabric: Fabric, console: Console) -> PixelDataset:
    columns = (TextColumn("reading images"), BarColumn(), MofNCompleteColumn())
    with Progress(*columns, console=console, transient=True, disable=not fabric.is_global_zero) as progress:
        task = progress.add_task("", total=len(capture.train_views))
        return PixelDataset(
            capture, capture.train_views, device=fabric.device, on_view=lambda _: progress.advance(task)
        )


def _preview(out: Path, capture: Capture, fabric: Fabric, reporter: Reporter):
    def preview(model: NeilfModel, stage: Stage) -> None:
        if fabric.is_global_zero:
            pixels = write_preview(model, capture, stage, out / "previews" / f"{stage.value}.png")
            reporter.picture(0, f"preview/{stage.value}", pixels)

    return preview


@contextmanager
def _stop_request() -> Iterator:
    """Ctrl-C and SIGTERM ask for a stop after the step in progress; a second Ctrl-C does not wait."""
    asked = []

    def ask(number: int, _frame: object) -> None:
        if asked:
            raise KeyboardInterrupt
        asked.append(number)

    try:
        before = {s: signal.signal(s, ask) for s in (signal.SIGINT, signal.SIGTERM)}
    except ValueError:  # Not the main thread: somebody else handles signals.
        before = {}
    try:
        yield lambda: bool(asked)
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)
