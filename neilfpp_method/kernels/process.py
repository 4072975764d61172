"""How a process computes: without denormal numbers, and with memory that it keeps.

Both are process-wide, so commands set them and a library does not. docs/performance.md: the gain.
"""

from __future__ import annotations

import ctypes
from collections.abc import Iterator
from contextlib import contextmanager

import torch

__all__ = ["computing_fast"]

# Options of glibc's allocator (malloc.h), and its own values in a process with large arrays.
TRIM_THRESHOLD, MMAP_THRESHOLD, MMAP_MAX = -1, -3, -4
OWN_TRIM, OWN_MMAP, OWN_MAPS = 64 << 20, 32 << 20, 65_536
NEVER = 2**31 - 1


@contextmanager
def computing_fast() -> Iterator[None]:
    """Settings for long computations on a CPU; afterwards the process is as it started.

    Denormal numbers, below 1.2e-38 in float32, count as 0. A steep softplus brings them by the million, and
    arithmetic on them takes some ten times as long; threads that start meanwhile inherit this. Memory that is
    freed stays with the process: glibc hands large arrays back, and gets the next one page by page, which
    takes longer than an elementwise pass over it. Where there is no glibc the second is left undone.
    """
    _set(fast=True)
    try:
        yield
    finally:
        _set(fast=False)


def _set(fast: bool) -> None:
    torch.set_flush_denormal(fast)
    try:
        libc = ctypes.CDLL(None)
        mallopt, malloc_trim = libc.mallopt, libc.malloc_trim
    except (AttributeError, TypeError, OSError):
        return
    mallopt(MMAP_THRESHOLD, OWN_MMAP)
    mallopt(MMAP_MAX, 0 if fast else OWN_MAPS)
    mallopt(TRIM_THRESHOLD, NEVER if fast else OWN_TRIM)
    if not fast:
        malloc_trim(0)
