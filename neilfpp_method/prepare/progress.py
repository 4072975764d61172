"""What a person sees while a capture is prepared: a bar for each step."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager

from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeElapsedColumn

__all__ = ["Bar", "Bars", "bars"]


class Bar:
    """The bar of one step: `to` sets it, `advance` moves it by one."""

    def __init__(self, progress: Progress, title: str, total: int) -> None:
        self._progress = progress
        self._task = progress.add_task(title, total=total)

    def to(self, done: int, total: int) -> None:
        """`done` of `total` are behind it."""
        self._progress.update(self._task, completed=done, total=total)

    def advance(self) -> None:
        """One further."""
        self._progress.advance(self._task)


Bars = Callable[[str, int], Bar]
"""Opens the bar of a step, with its title and length."""


@contextmanager
def bars(console: Console) -> Iterator[Bars]:
    """Bars one below another."""
    columns = (TextColumn("{task.description:20}"), BarColumn(), MofNCompleteColumn(), TimeElapsedColumn())
    with Progress(*columns, console=console) as progress:
        yield lambda title, total: Bar(progress, title, total)
