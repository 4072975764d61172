"""The routes of `benchmarks.kernels` as figures of the suite: an SDF behind a hash grid, its normal and their
backward pass; and softplus units, of which the paper's SDF has two thousand, by torch and by the compiled
loops.
"""

from __future__ import annotations

from collections.abc import Iterator

import torch
from torch.nn import functional

from benchmarks.kernels import measure
from benchmarks.measure import Measurement, device, median_seconds
from neilfpp_method.kernels.process import computing_fast
from neilfpp_method.kernels.softplus import softplus, softplus_and_slope
from neilfpp_method.settings.presets import preset

__all__ = ["measurements"]

POINTS = 8192
REPEATS = 5


def measurements() -> Iterator[Measurement]:
    """How many times faster than straightforward torch the package is, by preset, and the grid's share
    alone.
    """
    for name in ("fast", "paper-ngp"):
        medians = measure(preset(name).sdf, POINTS, REPEATS, torch.device("cpu"))
        for faster, slower in (
            ("reference", "naive"),
            ("fastest", "naive"),
            ("fastest, grid alone", "reference, grid alone"),
        ):
            ratio = medians[slower] / medians[faster]
            yield Measurement(f"kernels/{name}: {slower} over {faster}", ratio, "×", "higher", tolerance=0.4)
    yield from _units()


def _units() -> Iterator[Measurement]:
    z, sharpness = torch.randn(POINTS, 256, device=device()), 100.0
    routes = {
        "softplus": (lambda: functional.softplus(z, beta=sharpness), lambda: softplus(z, sharpness)),
        "softplus and slope": (
            lambda: (functional.softplus(z, beta=sharpness), torch.sigmoid(sharpness * z)),
            lambda: softplus_and_slope(z, sharpness),
        ),
    }
    with computing_fast():
        for name, (plain, ours) in routes.items():
            slower, faster = median_seconds(plain, ours)
            yield Measurement(
                f"kernels/{name}: torch over compiled", slower / faster, "×", "higher", tolerance=0.5
            )
