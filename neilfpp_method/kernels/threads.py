"""Work shared between threads of this process, as many as torch uses.

Compiled loops that let go of the interpreter's lock need no more than Python's own threads. A threading layer
of the compiler's would bring a second OpenMP beside torch's, or one that does not survive a fork.
"""

from __future__ import annotations

import itertools
import os
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from functools import lru_cache

import torch

__all__ = ["for_each", "shares"]


def shares(count: int, least: int) -> list[tuple[int, int]]:
    """`count` things in equal runs, (start, stop) each: one per thread, none shorter than `least`."""
    parts = max(1, min(torch.get_num_threads(), count // max(least, 1)))
    edges = [count * part // parts for part in range(parts + 1)]
    return list(itertools.pairwise(edges))


def for_each(work: Callable[[int, int], object], runs: Sequence[tuple[int, int]]) -> None:
    """`work(start, stop)` for every run, side by side; returns when all are done.

    Raises:
        Exception: what the first run that failed has raised.
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
    """The threads beside the calling one. They do not live on in a forked process, which makes its own."""
    return ThreadPoolExecutor(threads, thread_name_prefix=f"kernels-{process}")
