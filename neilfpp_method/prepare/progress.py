"""Progress bars of `neilfpp prepare`, one for each step."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager

from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeElapsedColumn

__all__ = ["Bar", "Bars", "bars"]


class Bar:
    """The progress bar of one step."""

    def __init__(self, progress: Progress, title: str, total: int) -> None:
        self._progress = progress
        self._task = progress.add_task(title, total=total)

    def to(self, done: int, total: int) -> None:
        """Set the bar to `done` of `total`."""
        self._progress.update(self._task, completed=done, total=total)

    def advance(self) -> None:
        """Move the bar by one."""
        self._progress.advance(self._task)


Bars = Callable[[str, int], Bar]
"""A function that opens the bar of a step, given its title and its total."""


@contextmanager
def bars(console: Console) -> Iterator[Bars]:
    """Show progress bars, one below the other, until the context ends."""
    columns = (TextColumn("{task.description:20}"), BarColumn(), MofNCompleteColumn(), TimeElapsedColumn())
    with Progress(*columns, console=console) as progress:
        yield lambda title, total: Bar(progress, title, total)
