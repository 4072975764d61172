"""What a person sees while a run trains: a bar per stage, TensorBoard, and a picture after each."""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from rich.console import Console
from rich.progress import (
    BarColumn,
    MofNCompleteColumn,
    Progress,
    TaskID,
    TextColumn,
    TimeElapsedColumn,
    TimeRemainingColumn,
)
from tensorboardX import SummaryWriter

__all__ = ["Reporter", "reporting"]

TITLES = {"sdf_init": "SDF init", "material_init": "material init", "joint": "joint"}


@dataclass
class Reporter:
    """The bars and the log of one process; a process that reports nothing has neither."""

    console: Console
    progress: Progress | None
    writer: SummaryWriter | None
    task: TaskID | None = None

    def begin_stage(self, stage: str, done: int, length: int) -> None:
        """Open a bar for a stage, `done` of whose `length` steps are behind it."""
        if self.progress is not None:
            self.task = self.progress.add_task(
                TITLES[stage], total=length, completed=done, loss="–", psnr="–"
            )

    def lengthen(self, length: int) -> None:
        """The stage has another number of steps than it began with."""
        if self.progress is not None and self.task is not None:
            self.progress.update(self.task, total=length)

    def step(self, loss: float, psnr: float) -> None:
        """One step further; `psnr` is NaN where the step compared no pixel."""
        if self.progress is not None and self.task is not None:
            shown = f"{psnr:.1f} dB" if math.isfinite(psnr) else "–"
            self.progress.update(self.task, advance=1, loss=f"{loss:.4f}", psnr=shown)

    def scalars(self, step: int, values: Mapping[str, float]) -> None:
        """Values for TensorBoard, where they are finite."""
        if self.writer is not None:
            for name, value in values.items():
                if math.isfinite(value):
                    self.writer.add_scalar(name, value, step)

    def picture(self, step: int, name: str, pixels: np.ndarray) -> None:
        """A picture (H, W, 3) uint8 for TensorBoard."""
        if self.writer is not None:
            self.writer.add_image(name, pixels, step, dataformats="HWC")

    def say(self, text: str) -> None:
        """A line for the person, above the bars, of something that is as it should be."""
        if self.progress is not None:
            self.console.print(text, markup=False, highlight=False, soft_wrap=True)

    def warn(self, text: str) -> None:
        """A line for the person, above the bars."""
        if self.progress is not None:
            self.console.print(text, style="yellow", markup=False, highlight=False, soft_wrap=True)


@contextmanager
def reporting(run: Path, console: Console, first_process: bool) -> Iterator[Reporter]:
    """Bars and log for the first process of a run; silence for the others."""
    if not first_process:
        yield Reporter(console, None, None)
        return
    progress = Progress(
        TextColumn("{task.description:14}"),
        BarColumn(),
        MofNCompleteColumn(),
        TextColumn("loss {task.fields[loss]}"),
        TextColumn("PSNR {task.fields[psnr]}"),
        TimeElapsedColumn(),
        TextColumn("left"),
        TimeRemainingColumn(),
        console=console,
    )
    writer = SummaryWriter(str(run / "tensorboard"))
    try:
        with progress:
            yield Reporter(console, progress, writer)
    finally:
        with suppress(
            OSError
        ):  # A disk that is full ends the run by what could not be saved, not by its log.
            writer.close()
