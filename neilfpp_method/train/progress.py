"""Progress output of a training: a progress bar per stage, console lines, and a TensorBoard log."""

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
    """Writes the progress of a training to the console and to TensorBoard.

    Attributes:
        console: the console.
        progress: the progress bars; None in a process that prints nothing.
        writer: the TensorBoard log; None in a process that writes none.
        task: the progress bar of the current stage.
    """

    console: Console
    progress: Progress | None
    writer: SummaryWriter | None
    task: TaskID | None = None

    def begin_stage(self, stage: str, done: int, length: int) -> None:
        """Add a progress bar for a stage with `length` steps, of which `done` are already trained."""
        if self.progress is not None:
            self.task = self.progress.add_task(
                TITLES[stage], total=length, completed=done, loss="–", psnr="–"
            )

    def lengthen(self, length: int) -> None:
        """Change the number of steps of the current stage."""
        if self.progress is not None and self.task is not None:
            self.progress.update(self.task, total=length)

    def step(self, loss: float, psnr: float) -> None:
        """Advance the progress bar by a step; `psnr` is NaN if the step compared no pixel."""
        if self.progress is not None and self.task is not None:
            decibels = f"{psnr:.1f} dB" if math.isfinite(psnr) else "–"
            self.progress.update(self.task, advance=1, loss=f"{loss:.4f}", psnr=decibels)

    def scalars(self, step: int, values: Mapping[str, float]) -> None:
        """Log the finite ones of some values to TensorBoard."""
        if self.writer is not None:
            for name, value in values.items():
                if math.isfinite(value):
                    self.writer.add_scalar(name, value, step)

    def picture(self, step: int, name: str, pixels: np.ndarray) -> None:
        """Log a picture, (H, W, 3) uint8, to TensorBoard."""
        if self.writer is not None:
            self.writer.add_image(name, pixels, step, dataformats="HWC")

    def say(self, text: str) -> None:
        """Print a line of information above the progress bars."""
        if self.progress is not None:
            self.console.print(text, markup=False, highlight=False, soft_wrap=True)

    def warn(self, text: str) -> None:
        """Print a warning above the progress bars."""
        if self.progress is not None:
            self.console.print(text, style="yellow", markup=False, highlight=False, soft_wrap=True)


@contextmanager
def reporting(run: Path, console: Console, first_process: bool) -> Iterator[Reporter]:
    """A reporter with progress bars and a log in the first process of a run, and a silent one in others."""
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
        # If the disk is full, the error is reported when a checkpoint cannot be saved; the log must not hide
        # it with an error of its own.
        with suppress(OSError):
            writer.close()
