"""Delay Ctrl-C and SIGTERM while a native library is loaded."""

from __future__ import annotations

import signal
import threading
from collections.abc import Iterator
from contextlib import contextmanager

__all__ = ["signals_delayed"]

SIGNALS = (signal.SIGINT, signal.SIGTERM)


@contextmanager
def signals_delayed() -> Iterator[None]:
    """Block both signals, and deliver one that arrives when the block ends, to the handler of before.

    Some native libraries install a handler of their own when they are loaded, and some catch an exception
    that a handler raises, print it, and go on half loaded. Threads that are started in the block inherit the
    blocked signals, so that they do not receive them in place of the main thread. Threads that run already do
    receive them, and Python then calls the handler in the main thread: it only takes note in the block.
    """
    # Windows has no signal masks.
    can_wait = hasattr(signal, "pthread_sigmask")
    blocked = signal.pthread_sigmask(signal.SIG_BLOCK, SIGNALS) if can_wait else set()
    arrived: list[int] = []
    handlers = {}
    if threading.current_thread() is threading.main_thread():
        found = {number: signal.getsignal(number) for number in SIGNALS}
        # None: installed by native code; Python could not restore it.
        handlers = {number: handler for number, handler in found.items() if handler is not None}
    for number in handlers:
        signal.signal(number, lambda number, _: arrived.append(number))
    try:
        yield
    finally:
        for number, handler in handlers.items():
            signal.signal(number, handler)
        if can_wait:
            signal.pthread_sigmask(signal.SIG_SETMASK, blocked)
        for number in arrived:
            signal.raise_signal(number)
