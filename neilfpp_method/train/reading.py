"""Read the pixels of the training views, in one process for all processes of a training."""

from __future__ import annotations

from pathlib import Path

from lightning_fabric import Fabric
from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn

from neilfpp_method.data.capture import Capture
from neilfpp_method.data.pixels.dataset import PixelDataset
from neilfpp_method.errors import UserError
from neilfpp_method.timing.ledger import timed

__all__ = ["load_training_pixels"]


@timed("data", undivided=True)
def load_training_pixels(capture: Capture, folder: Path, fabric: Fabric, console: Console) -> PixelDataset:
    """Read the training pixels into a folder in the first process, and open them there in all processes.

    Raises:
        UserError: in all processes, if an image cannot be read.
    """
    problem: tuple[str, str] | None = None
    if fabric.is_global_zero:
        try:
            pixels = _read_pixels(capture, folder, fabric, console)
        except UserError as error:
            problem = (error.problem, error.remedy)
    problem = fabric.broadcast(problem)
    if problem is not None:
        raise UserError(*problem)
    return pixels if fabric.is_global_zero else _read_pixels(capture, folder, fabric, console)


def _read_pixels(capture: Capture, folder: Path, fabric: Fabric, console: Console) -> PixelDataset:
    columns = (TextColumn("reading images"), BarColumn(), MofNCompleteColumn())
    hidden = not (fabric.is_global_zero and console.is_terminal)
    with Progress(*columns, console=console, transient=True, disable=hidden) as progress:
        task = progress.add_task("", total=len(capture.train_views))
        views = capture.train_views
        return PixelDataset(capture, views, fabric.device, lambda _: progress.advance(task), folder)
