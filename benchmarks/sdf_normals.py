"""The routes of `benchmarks.kernels` as figures of the suite: an SDF behind a hash grid, its normal and their backward pass."""

from __future__ import annotations

from collections.abc import Iterator

import torch

from benchmarks.kernels import measure
from benchmarks.measure import Measurement
from neilfpp_method.presets import preset

__all__ = ["measurements"]

POINTS = 8192
REPEATS = 5


def measurements() -> Iterator[Measurement]:
    """How many times faster than straightforward torch the package is, by preset, and the grid's share alone."""
    for name in ("fast", "paper-ngp"):
        medians = measure(preset(name).sdf, POINTS, REPEATS, torch.device("cpu"))
        for faster, slower in (("reference", "naive"), ("fastest", "naive"), ("fastest, grid alone", "reference, grid alone")):
            ratio = medians[slower] / medians[faster]
            yield Measurement(f"kernels/{name}: {slower} over {faster}", ratio, "×", "higher", tolerance=0.4)
