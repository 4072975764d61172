"""Delay SIGTERM while a native library is loaded."""

from __future__ import annotations

import signal
from collections.abc import Iterator
from contextlib import contextmanager, suppress

__all__ = ["sigterm_delayed"]


@contextmanager
def sigterm_delayed() -> Iterator[None]:
    """Block SIGTERM and restore its handler at the end of the block, when a pending signal is delivered.

    Some native libraries install a handler of their own when they are loaded. Threads that are started in the
    block inherit the blocked signal, so that they do not receive it in place of the main thread.
    """
    # Windows has no signal masks.
    can_wait = hasattr(signal, "pthread_sigmask")
    blocked = signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGTERM}) if can_wait else set()
    handler = signal.getsignal(signal.SIGTERM)
    try:
        yield
    finally:
        # Fails outside of the main thread, and if the previous handler is not a Python function.
        with suppress(ValueError, TypeError):
            signal.signal(signal.SIGTERM, handler)
        if can_wait:
            signal.pthread_sigmask(signal.SIG_SETMASK, blocked)
