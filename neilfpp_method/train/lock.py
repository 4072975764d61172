"""One training at a time in a run folder."""

from __future__ import annotations

import os
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

from neilfpp_method.errors import UserError

try:
    import fcntl
except ImportError:  # Windows
    fcntl = None

__all__ = ["LOCK", "alone_in"]

LOCK = ".training"
"""File of a run folder that a training holds while it is at work; it says which process that is."""


@contextmanager
def alone_in(folder: Path) -> Iterator[None]:
    """Hold a run folder, which is made where it is missing. The system lets go of it when the process ends,
    however it ends, so that a killed training is in nobody's way.

    The first process of a parallel training holds the folder for all of them. Where the file system, or the
    operating system, knows no locks (`flock`), nothing is held.

    Raises:
        UserError: another training holds it.
    """
    if fcntl is None or not _is_first_process():
        yield
        return
    folder.mkdir(parents=True, exist_ok=True)
    held = _taken(folder)
    try:
        yield
    finally:
        with suppress(OSError):
            (folder / LOCK).unlink()
        os.close(held)


def _is_first_process() -> bool:
    """Whether this is the first process of a parallel training.

    torchrun numbers the processes of all nodes by RANK; those that the training starts itself have a
    LOCAL_RANK only.
    """
    return os.environ.get("RANK", os.environ.get("LOCAL_RANK", "0")) == "0"


def _taken(folder: Path) -> int:
    """The open file of the folder, locked where locks are known."""
    path = folder / LOCK
    while True:
        held = os.open(path, os.O_RDWR | os.O_CREAT, 0o644)
        try:
            fcntl.flock(held, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError as error:
            process = os.read(held, 32).decode("ascii", "replace").strip() or "unknown"
            os.close(held)
            raise UserError(
                f"{folder}: another training is at work in this folder (process {process})",
                "wait for it, stop it, or choose another --out",
            ) from error
        except OSError:  # no locks on this file system
            return held
        # Between opening and locking, its holder may have ended, and have taken the file away.
        if path.exists() and os.path.samestat(os.fstat(held), path.stat()):
            os.ftruncate(held, 0)
            os.write(held, f"{os.getpid()}\n".encode())
            return held
        os.close(held)
