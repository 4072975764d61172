"""What a benchmark says, and how time and memory are measured."""

from __future__ import annotations

import platform
import statistics
import subprocess
import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

import torch

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
        name: what is measured, unique in the suite.
        value: the figure.
        unit: of the value; "×" for a ratio within one run, which other machines share.
        better: which way is better.
        tolerance: relative change for the worse that is not yet worse; none for a figure that no other
            machine shares, which is shown and never fails.
    """

    name: str
    value: float
    unit: str
    better: Literal["lower", "higher"]
    tolerance: float | None = None

    def worse_than(self, baseline: float) -> bool:
        """Whether the value lies on the wrong side of a baseline, by more than the tolerance."""
        if self.tolerance is None:
            return False
        if self.better == "lower":
            return self.value > baseline * (1 + self.tolerance)
        return self.value < baseline / (1 + self.tolerance)


def device() -> torch.device:
    """Where suites run: on a GPU where there is one. The committed baseline is a CPU's."""
    return torch.device("cuda" if torch.cuda.is_available() else "cpu")


def clock(where: torch.device) -> Callable[[], float]:
    """Seconds: of this process's own on a CPU, which others may share; of the clock, with all work done, on a
    GPU.
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
    """The median duration of each function, after one call that does not count; `where` they run, if not on
    `device()`.

    They take turns, so that whatever else the machine does falls on all of them: their ratios are worth more
    than their durations.
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
    """The machine in a line."""
    gpu = torch.cuda.get_device_name() if torch.cuda.is_available() else "none"
    return f"{_processor()}, {torch.get_num_threads()} thread(s), GPU {gpu}, torch {torch.__version__}"


def revision() -> str:
    """The commit that is measured, short; with a plus where files differ from it; "unknown" outside a
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


def _processor() -> str:
    cpuinfo = Path("/proc/cpuinfo")
    if cpuinfo.is_file():
        names = [
            line.split(":", 1)[1].strip()
            for line in cpuinfo.read_text().splitlines()
            if line.startswith("model name")
        ]
        if names:
            return names[0]
    return platform.processor() or platform.machine()


def yardstick() -> None:
    """Work that a machine does about as fast as ours: products of matrices and sines, some hundredths of a
    second.
    """
    x = torch.ones(2048, 256, device=device())
    weight = torch.full((256, 256), 1e-3, device=device())
    for _ in range(16):
        x = torch.sin(x @ weight)


def in_yardsticks(function: Callable[[], object], repetitions: int) -> float:
    """The duration of a function, in durations of `yardstick`: a figure that machines share better than
    seconds.
    """
    taken, unit = median_seconds(function, yardstick, repetitions=repetitions)
    return taken / unit
