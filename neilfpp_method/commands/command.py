"""The structure of a command, and helpers that several commands share."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from typing import Annotated, Any, Literal

import tyro
from rich.console import Console

__all__ = ["Checkpoint", "Command", "Device", "duration", "progress_bar", "terminal"]

MIN_ANNOUNCED_SECONDS = 10.0
"""Smallest estimate of the whole time, in seconds, that a progress bar prints."""
MIN_MEASURED_SECONDS = 2.0
"""Smallest time between two reports of progress, in seconds, from which the whole time is estimated."""

Device = Annotated[str, tyro.conf.arg(metavar="cpu|cuda|cuda:N|auto")]
"""Type of an option that names a device."""
Checkpoint = Literal["last", "sdf_init", "material_init", "joint"]
"""Type of an option that names a checkpoint of a run: the last one, or that at the end of a stage."""


@dataclass(frozen=True)
class Command:
    """A command of the command line.

    Attributes:
        options: a dataclass; its docstring is the summary of the command, those of its fields are the help.
        run: executes the command with its options.
        examples: command lines for the help.
        default: computes default options from the words of the command line, for a command where some
            options determine the defaults of others; None for the defaults of the dataclass.
        usual: a dataclass with fewer options for `--help`, if `options` has very many; `--help-all` then
            shows all of them.
    """

    options: type
    run: Callable[[Any], None]
    examples: Sequence[str]
    default: Callable[[Sequence[str]], Any] | None = None
    usual: type | None = None

    @property
    def summary(self) -> str:
        """The summary for the help."""
        return (self.options.__doc__ or "").strip()


def terminal() -> Console:
    """The console of a command. Text is printed literally, so that brackets in a path are not markup."""
    return Console(markup=False, highlight=False)


@contextmanager
def progress_bar(title: str) -> Iterator[Callable[[float], None]]:
    """A progress bar; yields a function that takes the share of the work that is done, from 0 to 1.

    When the total time can be estimated and is long, it is printed once. If the work fails, the bar is
    removed, so that the command prints only the error.
    """
    from rich.progress import BarColumn, Progress, TextColumn, TimeRemainingColumn

    share = TextColumn("{task.percentage:3.0f} %")
    pace = _Pace(time.monotonic())
    progress = Progress(TextColumn(title), BarColumn(), share, TimeRemainingColumn())
    task = progress.add_task(title, total=1.0)

    def advance(done: float) -> None:
        takes = pace.total(time.monotonic(), done)
        if takes is not None and takes > MIN_ANNOUNCED_SECONDS:
            progress.console.print(f"{title} takes about {duration(takes)}")
        progress.update(task, completed=done)

    progress.start()
    stop = progress.stop
    try:
        yield advance
    except Exception:
        progress.live.transient = True
        stop = progress.live.stop  # `Progress.stop` would print an empty line.
        raise
    finally:
        stop()


@dataclass
class _Pace:
    """Estimates once the total time of work that began at the time `began`.

    The time up to the first share is not extrapolated, because it contains loading and compiling.
    """

    began: float
    first: tuple[float, float] | None = None
    said: bool = False

    def total(self, now: float, done: float) -> float | None:
        """Return the seconds of the whole work once, as soon as they can be estimated, and otherwise None.

        They are estimated from two shares that are at least `MIN_MEASURED_SECONDS` apart.
        """
        if self.said or done <= 0:
            return None
        if self.first is None:
            self.first = now, done
            return None
        since, at = self.first
        if now - since < MIN_MEASURED_SECONDS or done <= at:
            return None
        self.said = True
        return now - self.began + (1 - done) * (now - since) / (done - at)


def duration(seconds: float) -> str:
    """A time rounded to about two digits.

    >>> duration(42.4), duration(200), duration(9000)
    ('42 s', '3 min', '2.5 h')
    """
    if seconds < 90:
        return f"{seconds:.0f} s"
    return f"{seconds / 60:.0f} min" if seconds < 5400 else f"{seconds / 3600:.1f} h"
