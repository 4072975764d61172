"""Hash-grid encoding on the CPU by compiled loops.

The points are divided among threads. For the gradient of the table the levels are divided instead, because
they share no rows; so the result is bitwise the same for any number of threads.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache

import numpy as np
import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from neilfpp_method.kernels import compiled
from neilfpp_method.kernels.function import Kernels, OutputGradients
from neilfpp_method.kernels.grid import Encoded, GridSpec
from neilfpp_method.kernels.threads import for_each, shares

__all__ = ["KERNELS"]

MIN_PAIRS_PER_THREAD = 16_384
"""Minimum work of a thread, in points times levels; with less, starting it costs more than it saves."""


@dataclass(frozen=True)
class Layout:
    """The layout of a grid with L levels as arrays for the compiled loops; E = L + 1."""

    offsets: Int[np.ndarray, " E"]
    cells: Int[np.ndarray, " L"]
    dense: Bool[np.ndarray, " L"]


@lru_cache(maxsize=32)
def _layout(spec: GridSpec) -> Layout:
    levels = range(len(spec.resolutions))
    return Layout(
        np.array(spec.offsets), np.array(spec.resolutions), np.array([spec.is_dense(i) for i in levels])
    )


def forward(
    x01: Float[Tensor, "N 3"], table: Float[Tensor, "T F"], spec: GridSpec, jacobian: bool
) -> Encoded:
    """See `Kernels`."""
    count = len(x01)
    features = table.new_empty(count, spec.width)
    slopes = table.new_empty(count if jacobian else 0, spec.width, 3)
    grid = _layout(spec)
    fixed = (*_arrays(x01, table), grid.offsets, grid.cells, grid.dense, *_arrays(features, slopes), jacobian)
    for_each(lambda start, stop: compiled.interpolate(*fixed, start, stop), _shares_of_points(count, spec))
    return Encoded(features, slopes if jacobian else None)


def table_gradient(
    x01: Float[Tensor, "N 3"], spec: GridSpec, gradients: OutputGradients
) -> Float[Tensor, "T F"]:
    """See `Kernels`."""
    table = x01.new_zeros(spec.entries, spec.features)
    grid = _layout(spec)
    fixed = (*_arrays(x01), grid.offsets, grid.cells, grid.dense, *_gradients(gradients), *_arrays(table))
    levels = len(spec.resolutions)
    runs = shares(levels, max(1, levels * MIN_PAIRS_PER_THREAD // max(1, len(x01) * levels)))
    for_each(lambda first, last: compiled.add_to_table(*fixed, first, last), runs)
    return table


def point_gradient(
    x01: Float[Tensor, "N 3"], table: Float[Tensor, "T F"], spec: GridSpec, gradients: OutputGradients
) -> Float[Tensor, "N 3"]:
    """See `Kernels`."""
    gradient = torch.empty_like(x01)
    grid = _layout(spec)
    fixed = (
        *_arrays(x01, table),
        grid.offsets,
        grid.cells,
        grid.dense,
        *_gradients(gradients),
        *_arrays(gradient),
    )
    for_each(
        lambda start, stop: compiled.point_gradient(*fixed, start, stop), _shares_of_points(len(x01), spec)
    )
    return gradient


def _shares_of_points(count: int, spec: GridSpec) -> list[tuple[int, int]]:
    return shares(count, MIN_PAIRS_PER_THREAD // len(spec.resolutions))


def _arrays(*tensors: Tensor) -> tuple[np.ndarray, ...]:
    return tuple(tensor.detach().contiguous().numpy() for tensor in tensors)


def _gradients(gradients: OutputGradients) -> tuple[np.ndarray, np.ndarray, bool]:
    """Both gradients as arrays, and whether that of the Jacobian exists; if not, its array is empty."""
    features, jacobian = gradients.features, gradients.jacobian
    exists = jacobian is not None
    return *_arrays(features, jacobian if exists else features.new_empty(0, 0, 3)), exists


KERNELS = Kernels(("cpu",), forward, table_gradient, point_gradient)
