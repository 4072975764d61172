"""The viewer during a training: a separate process that shows the newest checkpoint of the run."""

from __future__ import annotations

import subprocess
import sys
import tempfile
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path

from neilfpp_method.view.address import check_address
from neilfpp_method.view.command import check_viser

__all__ = ["viewer_beside"]

HOST = "127.0.0.1"
NORMAL_EXITS = (0, 130)
"""Exit statuses of a viewer that was stopped on purpose; Ctrl-C reaches both processes."""
SECONDS_TO_END = 10.0
"""Seconds after which a viewer that was asked to end is killed."""


@contextmanager
def viewer_beside(
    run: Path, port: int, device: str, say: Callable[[str], None]
) -> Iterator[subprocess.Popen]:
    """Serve `neilfpp view RUN --follow` while the context trains, and end it afterwards. Yields its process.

    The viewer only reads files, so nothing that it does, and no failure of it, affects the training.

    Args:
        run: the run's folder, which need not exist yet.
        port: port of the page on this machine.
        device: device on which the viewer computes.
        say: prints a line for the user.

    Raises:
        UserError: viser is not installed, or the port is not free.
    """
    check_viser()
    check_address(HOST, port, "--view-port")
    words = ["view", str(run), "--follow", "--host", HOST, "--port", str(port), "--device", device]
    with tempfile.TemporaryFile() as errors:
        process = subprocess.Popen(
            [sys.executable, "-m", "neilfpp_method.cli", *words], stdout=subprocess.DEVNULL, stderr=errors
        )
        say(f"open http://{HOST}:{port} in a browser to see the run from its first checkpoint on")
        try:
            yield process
        finally:
            if process.poll() is None:
                process.terminate()
                try:
                    process.wait(SECONDS_TO_END)
                except subprocess.TimeoutExpired:
                    process.kill()
                    process.wait()
            elif process.returncode not in NORMAL_EXITS:
                errors.seek(0)
                lines = errors.read().decode(errors="replace").strip().splitlines()
                say(f"the viewer ended early: {lines[-1] if lines else process.returncode}")
