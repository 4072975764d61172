"""What a command is, and the options that several of them have."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from typing import Annotated, Any, Literal

import tyro
from rich.console import Console

__all__ = ["Checkpoint", "Command", "Device", "duration", "progress_bar", "terminal"]

SOON = 10.0
"""Seconds; what takes no longer needs no word."""
MEASURED = 2.0
"""Seconds of progress from which the time of the whole work is estimated."""

Device = Annotated[str, tyro.conf.arg(metavar="cpu|cuda|cuda:N|auto")]
Checkpoint = Literal["last", "sdf_init", "material_init", "joint"]


@dataclass(frozen=True)
class Command:
    """A command of the command line.

    Attributes:
        options: a dataclass; its docstring is the command's summary, those of its fields are the help.
        run: does it.
        examples: command lines for the help.
        default: the options that a command line starts from, where some of its words decide what others
            default to; none: the defaults of the dataclass.
        usual: the dataclass that `--help` shows, where `options` has too many to read; `--help-all` then
            shows all.
    """

    options: type
    run: Callable[[Any], None]
    examples: Sequence[str]
    default: Callable[[Sequence[str]], Any] | None = None
    usual: type | None = None

    @property
    def summary(self) -> str:
        return (self.options.__doc__ or "").strip()


def terminal() -> Console:
    """Where a command speaks; what it says is shown as it is, brackets in a path included."""
    return Console(markup=False, highlight=False)


@contextmanager
def progress_bar(title: str) -> Iterator[Callable[[float], None]]:
    """A progress bar of the share done. Once the pace is known, it prints how long the whole work takes.

    If the work fails, the bar is removed: the error is then all that the command prints.
    """
    from rich.progress import BarColumn, Progress, TextColumn, TimeRemainingColumn

    share = TextColumn("{task.percentage:3.0f} %")
    pace = _Pace(time.monotonic())
    progress = Progress(TextColumn(title), BarColumn(), share, TimeRemainingColumn())
    task = progress.add_task(title, total=1.0)

    def advance(done: float) -> None:
        takes = pace.total(time.monotonic(), done)
        if takes is not None and takes > SOON:
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
    """Estimates once how long work takes that began at the time `began`.

    The first share is not counted, because loading and compiling go before it.
    """

    began: float
    first: tuple[float, float] | None = None
    said: bool = False

    def total(self, now: float, done: float) -> float | None:
        """Return the seconds of the whole work, once `MEASURED` seconds lie between two shares, else None."""
        if self.said or done <= 0:
            return None
        if self.first is None:
            self.first = now, done
            return None
        since, at = self.first
        if now - since < MEASURED or done <= at:
            return None
        self.said = True
        return now - self.began + (1 - done) * (now - since) / (done - at)


def duration(seconds: float) -> str:
    """A time for people: two digits are enough.

    >>> duration(42.4), duration(200), duration(9000)
    ('42 s', '3 min', '2.5 h')
    """
    if seconds < 90:
        return f"{seconds:.0f} s"
    return f"{seconds / 60:.0f} min" if seconds < 5400 else f"{seconds / 3600:.1f} h"
