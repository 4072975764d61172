"""Process-wide settings for fast computation: flush denormal numbers to 0, and keep freed memory.

They affect the whole process, so only commands set them, not the library. docs/performance.md has the gain.
"""

from __future__ import annotations

import ctypes
from collections.abc import Iterator
from contextlib import contextmanager

import torch

__all__ = ["computing_fast"]

TRIM_THRESHOLD, MMAP_THRESHOLD, MMAP_MAX = -1, -3, -4
"""Numbers of the options of glibc's allocator (malloc.h)."""
OWN_TRIM, OWN_MMAP, OWN_MAPS = 64 << 20, 32 << 20, 65_536
"""Values that glibc itself chooses for these options in a process with large arrays."""
NEVER_TRIM = 2**31 - 1
"""Trim threshold at which memory is never returned to the system."""


@contextmanager
def computing_fast() -> Iterator[None]:
    """Apply settings for long computations on a CPU, and restore the default ones afterwards.

    Denormal numbers, below 1.2e-38 in float32, are flushed to 0. A steep softplus produces millions of them,
    and arithmetic on them takes about ten times as long. Threads that are started in the context inherit
    this setting. Freed memory stays with the process: by default glibc returns large arrays to the system and
    gets the next one page by page, which takes longer than an elementwise pass over it. Without glibc the
    second setting is not made.
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
    mallopt(TRIM_THRESHOLD, NEVER_TRIM if fast else OWN_TRIM)
    if not fast:
        malloc_trim(0)
