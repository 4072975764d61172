"""Stop a training on Ctrl-C or SIGTERM, and make the command line that continues it."""

from __future__ import annotations

import shlex
import signal
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path

from neilfpp_method.errors import Stopped
from neilfpp_method.train.request import TrainingRequest

__all__ = ["continue_command", "stop_request"]


def continue_command(request: TrainingRequest, out: Path) -> str:
    """The command line that continues a stopped run."""
    options = ["--device", request.device] if request.device != "auto" else []
    options += ["--devices", str(request.devices)] if request.devices != 1 else []
    options += ["--nodes", str(request.nodes)] if request.nodes != 1 else []
    return f"{request.command} {shlex.join(['--out', str(out), '--resume', *options])}"


@contextmanager
def stop_request(continue_with: str) -> Iterator[Callable[[], bool]]:
    """Handle Ctrl-C and SIGTERM; yields a function that returns whether a stop has been requested.

    The first signal requests a stop after the current step. A second one stops at once and loses the steps
    since the last checkpoint.
    """
    received = []

    def handle(number: int, _frame: object) -> None:
        if received:
            raise KeyboardInterrupt
        received.append(number)

    try:
        previous = {s: signal.signal(s, handle) for s in (signal.SIGINT, signal.SIGTERM)}
    except ValueError:
        # Signal handlers can only be set in the main thread.
        previous = {}
    try:
        yield lambda: bool(received)
    except KeyboardInterrupt:
        raise Stopped("stopped at once", f"continue from the last checkpoint with: {continue_with}") from None
    finally:
        for number, handler in previous.items():
            signal.signal(number, handler)
