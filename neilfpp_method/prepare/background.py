"""Run long native calls in a second thread, so that the main thread can show progress and handle Ctrl-C."""

from __future__ import annotations

import signal
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import TypeVar

from neilfpp_method.data.cameras.colmap_library import pycolmap

__all__ = ["in_background", "sigterm_as_ctrl_c", "silent"]

Result = TypeVar("Result")
UPDATE_SECONDS = 0.2
"""Seconds between two updates of the progress bar."""


def in_background(
    call: Callable[[pycolmap.CancellationToken], Result], update: Callable[[], None] = lambda: None
) -> Result:
    """Run `call` in a second thread and return its result, or raise its exception.

    Args:
        call: a native call that observes the cancellation token.
        update: called in the main thread every `UPDATE_SECONDS` while `call` runs, and once at the end.

    Raises:
        KeyboardInterrupt: Ctrl-C was pressed. `call` has been cancelled and has ended.
    """
    token = pycolmap.CancellationToken()
    outcome: list[Result] = []
    failure: list[BaseException] = []
    # Thread.join is not used: after an interruption by Ctrl-C, CPython 3.11 treats the thread as ended.
    ended = threading.Event()

    def work() -> None:
        try:
            outcome.append(call(token))
        except BaseException as error:
            failure.append(error)
        finally:
            ended.set()

    threading.Thread(target=work, daemon=True).start()
    try:
        while not ended.wait(UPDATE_SECONDS):
            update()
        update()
    except BaseException:
        token.cancel()
        ended.wait()
        raise
    if failure:
        raise failure[0]
    return outcome[0]


@contextmanager
def sigterm_as_ctrl_c() -> Iterator[None]:
    """Raise `KeyboardInterrupt` on SIGTERM, the signal by which schedulers end a job, as on Ctrl-C."""
    try:
        before = signal.signal(signal.SIGTERM, signal.default_int_handler)
    except ValueError:
        # Outside of the main thread Python allows no signal handlers.
        yield
        return
    try:
        yield
    finally:
        signal.signal(signal.SIGTERM, before)


def silent() -> None:
    """Switch off COLMAP's log of every image on standard error; progress bars and a summary replace it."""
    pycolmap.logging.minloglevel = int(pycolmap.logging.Level.FATAL.value)
