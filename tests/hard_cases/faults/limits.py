"""Folders that cannot be written, and disks that are full, in this process."""

from __future__ import annotations

import ctypes
import resource
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

__all__ = ["largest_file", "read_only"]

_VERSION = 0x20080522
"""Version 3 of the interface of capget(2)."""
_OVERRIDE = 0b110
"""CAP_DAC_OVERRIDE and CAP_DAC_READ_SEARCH: root may read and write any file."""


@contextmanager
def largest_file(size: int) -> Iterator[None]:
    """Writing a file beyond so many bytes fails, as on a full disk."""
    before = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (size, before[1]))
    try:
        yield
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, before)


@contextmanager
def read_only(folder: Path) -> Iterator[None]:
    """Nothing in the folder can be created, changed or removed, also not by root."""
    files = {path: path.stat().st_mode for path in (folder, *folder.rglob("*"))}
    effective = _effective()
    for path, mode in files.items():
        path.chmod(mode & 0o555)
    _set_effective(effective & ~_OVERRIDE)
    try:
        yield
    finally:
        _set_effective(effective)
        for path, mode in files.items():
            path.chmod(mode)


def _call(name: str, data: ctypes.Array[ctypes.c_uint32]) -> None:
    """Call capget or capset for this thread."""
    libc = ctypes.CDLL(None, use_errno=True)
    if getattr(libc, name)((ctypes.c_uint32 * 2)(_VERSION, 0), data):
        raise OSError(ctypes.get_errno(), f"{name} failed")


def _effective() -> int:
    """The lower 32 capabilities in effect, which include those that permit to write any file."""
    _call("capget", data := (ctypes.c_uint32 * 6)())
    return data[0]


def _set_effective(lower: int) -> None:
    _call("capget", data := (ctypes.c_uint32 * 6)())
    data[0] = lower
    _call("capset", data)
