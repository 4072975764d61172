"""Handle Ctrl-C, SIGTERM and a closed standard output, so that a command ends without a traceback."""

from __future__ import annotations

import os
import select
import signal
import sys
from collections.abc import Iterator
from contextlib import contextmanager, suppress

__all__ = ["CLOSED_OUTPUT", "EndSignal", "ended_by_signal", "output_is_closed"]

CLOSED_OUTPUT = 141
"""The exit status that shells report for a process whose output is no longer read: 128 + SIGPIPE."""


class EndSignal:
    """The signal that asked the process to end; `number` is 0 if there was none."""

    def __init__(self) -> None:
        self.number = 0

    @property
    def status(self) -> int:
        """The exit status that shells report for a process ended by this signal: 130 or 143."""
        return 128 + self.number


@contextmanager
def ended_by_signal() -> Iterator[EndSignal]:
    """Raise `KeyboardInterrupt` in the context on Ctrl-C and SIGTERM, so that temporary files are removed.

    The signal is also recorded in the yielded object, because an extension module that is being loaded may
    turn the exception into one of its own.
    """
    ending = EndSignal()

    def handle(number: int, _frame: object) -> None:
        ending.number = number
        raise KeyboardInterrupt

    previous = {}
    # Signal handlers can only be set in the main thread.
    with suppress(ValueError):
        for number in (signal.SIGINT, signal.SIGTERM):
            previous[number] = signal.signal(number, handle)
    try:
        yield ending
    finally:
        for number, handler in previous.items():
            signal.signal(number, handler)


def output_is_closed() -> bool:
    """Return whether the reader of standard output has ended, as `head` does; the rest is then discarded."""
    poll = select.poll()
    poll.register(sys.stdout.fileno(), 0)
    is_closed = any(event & select.POLLERR for _, event in poll.poll(0))
    if is_closed:
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
    return is_closed
