"""Delay Ctrl-C and SIGTERM while a native library is loaded."""

from __future__ import annotations

import signal
from collections.abc import Iterator
from contextlib import contextmanager, suppress

__all__ = ["signals_delayed"]

SIGNALS = (signal.SIGINT, signal.SIGTERM)


@contextmanager
def signals_delayed() -> Iterator[None]:
    """Block both signals and restore their handlers at the end of the block, when a pending one is delivered.

    Some native libraries install a handler of their own when they are loaded, and some catch an exception
    that a handler raises, print it, and go on half loaded. Threads that are started in the block inherit the
    blocked signals, so that they do not receive them in place of the main thread.
    """
    # Windows has no signal masks.
    can_wait = hasattr(signal, "pthread_sigmask")
    blocked = signal.pthread_sigmask(signal.SIG_BLOCK, SIGNALS) if can_wait else set()
    handlers = {number: signal.getsignal(number) for number in SIGNALS}
    try:
        yield
    finally:
        # Fails outside of the main thread, and if the previous handler is not a Python function.
        with suppress(ValueError, TypeError):
            for number, handler in handlers.items():
                signal.signal(number, handler)
        if can_wait:
            signal.pthread_sigmask(signal.SIG_SETMASK, blocked)
