"""SIGTERM while a native library is loaded."""

from __future__ import annotations

import signal
from collections.abc import Iterator
from contextlib import contextmanager, suppress

__all__ = ["sigterm_waits"]


@contextmanager
def sigterm_waits() -> Iterator[None]:
    """A SIGTERM that arrives in the block is delivered at its end, to the handler of before the block: native
    libraries put their own in its place when they are loaded.

    Threads that the block starts do not take SIGTERM for the main thread, either.
    """
    can_wait = hasattr(signal, "pthread_sigmask")  # not on Windows
    blocked = signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGTERM}) if can_wait else set()
    handler = signal.getsignal(signal.SIGTERM)
    try:
        yield
    finally:
        with suppress(ValueError, TypeError):  # not the main thread, or a handler that is not Python's
            signal.signal(signal.SIGTERM, handler)
        if can_wait:
            signal.pthread_sigmask(signal.SIG_SETMASK, blocked)
