"""Ctrl-C and SIGTERM: a command that is asked to end does so without a trace of its inside."""

from __future__ import annotations

import signal
from collections.abc import Iterator
from contextlib import contextmanager, suppress

__all__ = ["Asked", "ended_by_signal"]


class Asked:
    """Which signal has asked the process to end; none: 0."""

    def __init__(self) -> None:
        self.number = 0

    @property
    def status(self) -> int:
        """The exit status that shells give a process that the signal ended: 130 or 143."""
        return 128 + self.number


@contextmanager
def ended_by_signal() -> Iterator[Asked]:
    """Ctrl-C and SIGTERM raise `KeyboardInterrupt` in the block, so that files that are half written are
    removed, and are noted: an extension that is being loaded turns the exception into one of its own.
    """
    asked = Asked()

    def ask(number: int, _frame: object) -> None:
        asked.number = number
        raise KeyboardInterrupt

    before = {}
    with suppress(ValueError):  # not the main thread: somebody else handles signals
        for number in (signal.SIGINT, signal.SIGTERM):
            before[number] = signal.signal(number, ask)
    try:
        yield asked
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)
