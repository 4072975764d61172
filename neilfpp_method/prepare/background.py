"""Native calls that take minutes run beside the main thread, which shows progress and can stop them."""

from __future__ import annotations

import signal
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import TypeVar

from neilfpp_method.data.colmap_library import pycolmap

__all__ = ["in_background", "sigterm_as_ctrl_c", "silent"]

Result = TypeVar("Result")
INTERVAL = 0.2


def in_background(
    call: Callable[[pycolmap.CancellationToken], Result], look: Callable[[], None] = lambda: None
) -> Result:
    """What `call` returns or raises; `look` is called several times a second meanwhile, and once at the end.

    Raises:
        KeyboardInterrupt: a person asked to stop; the call has been told, and has ended.
    """
    token = pycolmap.CancellationToken()
    outcome: list[Result] = []
    failure: list[BaseException] = []
    ended = threading.Event()  # Thread.join forgets its thread when Ctrl-C interrupts it (CPython 3.11)

    def work() -> None:
        try:
            outcome.append(call(token))
        except BaseException as error:
            failure.append(error)
        finally:
            ended.set()

    threading.Thread(target=work, daemon=True).start()
    try:
        while not ended.wait(INTERVAL):
            look()
        look()
    except BaseException:
        token.cancel()
        ended.wait()
        raise
    if failure:
        raise failure[0]
    return outcome[0]


@contextmanager
def sigterm_as_ctrl_c() -> Iterator[None]:
    """SIGTERM, by which schedulers end a command, acts like a person's stop: a `KeyboardInterrupt`."""
    try:
        before = signal.signal(signal.SIGTERM, signal.default_int_handler)
    except ValueError:  # not the main thread: somebody else handles signals
        yield
        return
    try:
        yield
    finally:
        signal.signal(signal.SIGTERM, before)


def silent() -> None:
    """COLMAP reports every image on the standard error; bars and a summary take its place."""
    pycolmap.logging.minloglevel = int(pycolmap.logging.Level.FATAL.value)
