"""Divide work among threads of this process, as many as torch uses.

The compiled loops release the interpreter's lock, so Python threads are sufficient. The threading layers of
the compiler would load a second OpenMP library next to that of torch, or would not survive a fork.
"""

from __future__ import annotations

import itertools
import os
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from functools import lru_cache

import torch

__all__ = ["for_each", "shares"]


def shares(count: int, min_count: int) -> list[tuple[int, int]]:
    """Divide `count` items into equal ranges (start, stop).

    There are as many ranges as threads, but fewer if a range would have less than `min_count` items.
    """
    parts = max(1, min(torch.get_num_threads(), count // max(min_count, 1)))
    edges = [count * part // parts for part in range(parts + 1)]
    return list(itertools.pairwise(edges))


def for_each(work: Callable[[int, int], object], runs: Sequence[tuple[int, int]]) -> None:
    """Call `work(start, stop)` for every range in parallel, and return when all calls are finished.

    Raises:
        Exception: that of the first range whose call has failed.
    """
    if len(runs) == 1:
        work(*runs[0])
        return
    others = [_pool(os.getpid(), len(runs) - 1).submit(work, *run) for run in runs[1:]]
    work(*runs[0])
    for other in others:
        other.result()


@lru_cache(maxsize=1)
def _pool(process: int, threads: int) -> ThreadPoolExecutor:
    """The threads besides the calling one. A forked process does not inherit them and makes its own."""
    return ThreadPoolExecutor(threads, thread_name_prefix=f"kernels-{process}")
