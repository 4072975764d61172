"""How a process computes: without denormal numbers, with memory that it keeps, with products of rounded factors.

The first two are settings of the whole process, so a command makes them and a library does not. docs/performance.md has what
they gain.
"""

from __future__ import annotations

import ctypes
from collections.abc import Iterator
from contextlib import AbstractContextManager, contextmanager, nullcontext

import torch

__all__ = ["computing_fast", "half_precision", "has_half_units", "rounded_products"]

# Options of glibc's allocator (malloc.h), and the values that it comes to by itself in a process with large arrays.
TRIM_THRESHOLD, MMAP_THRESHOLD, MMAP_MAX = -1, -3, -4
OWN_TRIM, OWN_MMAP, OWN_MAPS = 64 << 20, 32 << 20, 65_536
NEVER = 2**31 - 1


@contextmanager
def computing_fast() -> Iterator[None]:
    """Settings for long computations on a CPU; afterwards the process is as it started.

    Denormal numbers, below 1.2e-38 in float32, count as 0. A steep softplus brings them by the million, and arithmetic on
    them takes some ten times as long; threads that start meanwhile inherit this. Memory that is freed stays with the process:
    glibc hands large arrays back, and gets the next one page by page, which takes longer than an elementwise pass over it.
    Where there is no glibc the second is left undone.
    """
    _set(fast=True)
    try:
        yield
    finally:
        _set(fast=False)


@contextmanager
def rounded_products(rounded: bool = True) -> Iterator[None]:
    """Products of float32 matrices with rounded factors (bfloat16; TF32 on a GPU) and exact sums, where the machine has units
    for that; elsewhere, and where `rounded` is off, all exact. Afterwards the process is as it was."""
    before = torch.get_float32_matmul_precision()
    torch.set_float32_matmul_precision("medium" if rounded else before)
    try:
        yield
    finally:
        torch.set_float32_matmul_precision(before)


def half_precision(device: torch.device, wanted: bool = True) -> AbstractContextManager:
    """Linear layers in float16, eleven bits to a number, with sums in float32, where the device has units for that; elsewhere,
    and where it is not wanted, as ever."""
    return torch.autocast(device.type, torch.float16) if wanted and has_half_units(device.type) else nullcontext()


def has_half_units(kind: str) -> bool:
    """Whether devices of a kind ("cpu", "cuda") multiply matrices of float16 in units for that."""
    if kind != "cpu":
        return kind == "cuda"
    known = getattr(torch.cpu, "get_capabilities", dict)()  # torch below 2.10 does not say
    return bool(known.get("avx512_fp16") or known.get("amx_fp16"))


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
