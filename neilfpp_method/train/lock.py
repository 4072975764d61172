"""A lock that prevents two trainings from using the same run folder."""

from __future__ import annotations

import os
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

from neilfpp_method.errors import UserError

try:
    import fcntl
except ImportError:
    # Windows has no fcntl.
    fcntl = None

__all__ = ["LOCK", "run_lock"]

LOCK = ".training"
"""The lock file in a run folder. It contains the id of the process that holds it."""


@contextmanager
def run_lock(folder: Path) -> Iterator[None]:
    """Lock a run folder for the duration of the context; the folder is created if it is missing.

    The operating system releases the lock when the process ends in any way, so a killed training does not
    block the folder. In a parallel training the first process holds the lock for all. If the operating
    system or the file system does not support locks (`flock`), nothing is locked.

    Raises:
        UserError: if another training holds the lock.
    """
    if fcntl is None or not _is_first_process():
        yield
        return
    folder.mkdir(parents=True, exist_ok=True)
    lock = _acquire(folder)
    try:
        yield
    finally:
        with suppress(OSError):
            (folder / LOCK).unlink()
        os.close(lock)


def _is_first_process() -> bool:
    """Whether this is the first process of a parallel training.

    torchrun numbers the processes of all nodes by RANK. Processes that the training starts itself have only a
    LOCAL_RANK.
    """
    return os.environ.get("RANK", os.environ.get("LOCAL_RANK", "0")) == "0"


def _acquire(folder: Path) -> int:
    """Descriptor of the open lock file, which is locked if the file system supports locks."""
    path = folder / LOCK
    while True:
        lock = os.open(path, os.O_RDWR | os.O_CREAT, 0o644)
        try:
            fcntl.flock(lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError as error:
            process = os.read(lock, 32).decode("ascii", "replace").strip() or "unknown"
            os.close(lock)
            raise UserError(
                f"{folder}: another training is running in this folder (process {process})",
                "wait for it, stop it, or choose another --out",
            ) from error
        except OSError:
            # The file system does not support locks.
            return lock
        # Between opening and locking, the previous holder may have ended and removed the file: try again.
        if path.exists() and os.path.samestat(os.fstat(lock), path.stat()):
            os.ftruncate(lock, 0)
            os.write(lock, f"{os.getpid()}\n".encode())
            return lock
        os.close(lock)
