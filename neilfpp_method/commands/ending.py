"""Handle Ctrl-C, SIGTERM and a closed standard output, so that a command ends without a traceback."""

from __future__ import annotations

import _thread
import os
import select
import signal
import sys
import threading
from collections.abc import Iterator
from contextlib import contextmanager, suppress

__all__ = ["CLOSED_OUTPUT", "EndSignal", "ended_by_signal", "forget_interrupt", "output_is_closed"]

CLOSED_OUTPUT = 141
"""The exit status that shells report for a process whose output is no longer read: 128 + SIGPIPE."""
SECONDS_UNTIL_RAISED_AGAIN = 0.05
"""Time after which a signal whose exception was ignored is raised once more, in seconds."""


class EndSignal:
    """The signal that asked the process to end; `number` is 0 if there was none, `hook` the hook of before.

    The first one counts. The signal is recorded in addition to the exception that it raises, because an
    extension module that is being loaded may turn the exception into one of its own.
    """

    def __init__(self) -> None:
        self.number = 0
        self._raises = False
        self.hook = sys.unraisablehook
        self._again: threading.Timer | None = None

    @property
    def status(self) -> int:
        """The exit status that shells report for a process ended by this signal: 130 or 143."""
        return 128 + self.number

    @contextmanager
    def raised(self) -> Iterator[None]:
        """Raise `KeyboardInterrupt` in the context on each signal, also on one that has arrived before it.

        It may be raised while the context is entered or left as well, so the statement that handles it must
        enclose the `with` statement.
        """
        self._raises = True
        try:
            if self.number:
                raise KeyboardInterrupt
            yield
        finally:
            self._raises = False
            if self._again is not None:
                self._again.cancel()

    def handle(self, number: int, _frame: object) -> None:
        """The handler of the signals."""
        self.number = self.number or number
        if self._raises:
            raise KeyboardInterrupt

    def raise_ignored(self, ignored: sys.UnraisableHookArgs) -> None:
        """The hook for exceptions that Python ignores: a `KeyboardInterrupt` is raised again, a little later.

        Python ignores what is raised in a callback from a native library, such as Numba's compiler, and in a
        finaliser: the command would go on although it was asked to end. Other exceptions after the signal
        come from objects that it left half made, and are not shown.
        """
        if not self.number:
            self.hook(ignored)
        elif self._raises and issubclass(ignored.exc_type, KeyboardInterrupt):
            self._again = threading.Timer(SECONDS_UNTIL_RAISED_AGAIN, _interrupt, (self.number,))
            self._again.daemon = True
            self._again.start()


def _interrupt(number: int) -> None:
    """Send the signal to the main thread, where it ends a wait as well."""
    if hasattr(signal, "pthread_kill"):
        signal.pthread_kill(threading.main_thread().ident, number)
    else:  # Windows
        _thread.interrupt_main(number)


@contextmanager
def ended_by_signal() -> Iterator[EndSignal]:
    """Handle Ctrl-C and SIGTERM in the context, so that temporary files are removed.

    A signal is recorded at any time, and raised only in `EndSignal.raised`: an exception while handlers are
    installed, or while the message of the end is printed, would end the process with a traceback. Signals
    that the start of the process has blocked are received here.
    """
    ending, signals = EndSignal(), (signal.SIGINT, signal.SIGTERM)
    can_wait = hasattr(signal, "pthread_sigmask")
    previous = {}
    sys.unraisablehook = ending.raise_ignored
    # Signal handlers can only be set in the main thread.
    with suppress(ValueError):
        for number in signals:
            previous[number] = signal.signal(number, ending.handle)
    blocked = signal.pthread_sigmask(signal.SIG_UNBLOCK, signals) if can_wait and previous else None
    try:
        yield ending
    finally:
        sys.unraisablehook = ending.hook
        if blocked is not None:
            signal.pthread_sigmask(signal.SIG_SETMASK, blocked)
        for number, handler in previous.items():
            signal.signal(number, handler)


def forget_interrupt() -> None:
    """Let the exit status stand after a handled `KeyboardInterrupt`.

    Python remembers a `KeyboardInterrupt` that leaves code which a string or a native library ran, even if it
    is handled later, and `python -m` then ends by SIGINT whatever the status. To run other code in this way
    clears it.
    """
    exec("")


def output_is_closed() -> bool:
    """Return whether the reader of standard output has ended, as `head` does; the rest is then discarded."""
    poll = select.poll()
    poll.register(sys.stdout.fileno(), 0)
    is_closed = any(event & select.POLLERR for _, event in poll.poll(0))
    if is_closed:
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
    return is_closed
