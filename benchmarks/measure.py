"""The figures of benchmarks, and the measurement of time and memory."""

from __future__ import annotations

import statistics
import subprocess
import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

import torch

from neilfpp_method.train.provenance import processor_name

__all__ = [
    "Measurement",
    "clock",
    "device",
    "hardware",
    "in_yardsticks",
    "median_seconds",
    "revision",
    "yardstick",
]


@dataclass(frozen=True)
class Measurement:
    """A figure that is compared with the committed one.

    Attributes:
        name: the measured quantity, unique in the suite.
        value: the figure.
        unit: unit of the value; "×" for a ratio within one run, which is comparable between machines.
        better: whether higher or lower values are better.
        tolerance: relative deterioration that is permitted; None for a figure that is not comparable between
            machines, which is shown and never fails.
    """

    name: str
    value: float
    unit: str
    better: Literal["lower", "higher"]
    tolerance: float | None = None

    def worse_than(self, baseline: float) -> bool:
        """Whether the value is worse than a baseline by more than the tolerance."""
        if self.tolerance is None:
            return False
        if self.better == "lower":
            return self.value > baseline * (1 + self.tolerance)
        return self.value < baseline / (1 + self.tolerance)


def device() -> torch.device:
    """Device of the suites: a GPU if there is one. The committed baseline was measured on a CPU."""
    return torch.device("cuda" if torch.cuda.is_available() else "cpu")


def clock(where: torch.device) -> Callable[[], float]:
    """A clock in seconds: CPU time of this process on a CPU, which other processes may share; wall-clock time
    after all work is done on a GPU.
    """
    if where.type != "cuda":
        return time.process_time

    def now() -> float:
        torch.cuda.synchronize(where)
        return time.perf_counter()

    return now


def median_seconds(
    *functions: Callable[[], object], repetitions: int = 7, where: torch.device | None = None
) -> list[float]:
    """The median duration of each function, after one call that is not counted; `where` is their device, by
    default `device()`.

    The functions alternate, so that other work on the machine affects all of them equally: their ratios are
    more reliable than their durations.
    """
    now = clock(where or device())
    for function in functions:
        function()
    seconds: list[list[float]] = [[] for _ in functions]
    for _ in range(repetitions):
        for function, taken in zip(functions, seconds, strict=True):
            started = now()
            function()
            taken.append(now() - started)
    return [statistics.median(taken) for taken in seconds]


def hardware() -> str:
    """Description of the machine in one line."""
    gpu = torch.cuda.get_device_name() if torch.cuda.is_available() else "none"
    return f"{processor_name()}, {torch.get_num_threads()} thread(s), GPU {gpu}, torch {torch.__version__}"


def revision() -> str:
    """Short hash of the measured commit, with a plus if files differ from it; "unknown" outside of a
    repository.
    """
    try:
        command = [
            "git",
            "-C",
            str(Path(__file__).parent),
            "describe",
            "--always",
            "--exclude",
            "*",
            "--abbrev=7",
            "--dirty=+",
        ]
        return subprocess.run(command, capture_output=True, text=True, check=True).stdout.strip()
    except (OSError, subprocess.CalledProcessError):
        return "unknown"


def yardstick() -> None:
    """Work whose speed on a machine is similar to that of this package: products of matrices and sines, some
    hundredths of a second.
    """
    x = torch.ones(2048, 256, device=device())
    weight = torch.full((256, 256), 1e-3, device=device())
    for _ in range(16):
        x = torch.sin(x @ weight)


def in_yardsticks(function: Callable[[], object], repetitions: int) -> float:
    """The duration of a function in units of that of `yardstick`, which is more comparable between machines
    than seconds.
    """
    taken, unit = median_seconds(function, yardstick, repetitions=repetitions)
    return taken / unit
