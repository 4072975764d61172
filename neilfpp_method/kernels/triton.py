"""Hash-grid encoding on a GPU by Triton, or on CPU tensors by Triton's interpreter (`TRITON_INTERPRET=1`).

A Triton program computes one level for a block of points. Features and Jacobian are stored with the points as
the last axis, so that neighbouring lanes write neighbouring numbers. The gradient of the table is accumulated
by atomic additions, so repeated runs differ by rounding. The vertices of a cell are numbered x + 2 y + 4 z.
"""

from __future__ import annotations

import inspect
import os
from collections.abc import Callable
from functools import lru_cache

import torch
import triton
import triton.language as tl
from jaxtyping import Float, Int
from torch import Tensor

from neilfpp_method.kernels.function import Kernels, OutputGradients
from neilfpp_method.kernels.grid import Encoded, GridSpec

__all__ = ["KERNELS"]

BLOCK = 128
"""Number of points that one program computes."""
FUSED = {"enable_fp_fusion": True}
"""Launch option: the compiler may fuse a product and a sum, as on the CPU."""


def kernel(function: Callable) -> triton.runtime.KernelInterface:
    """Make a function a Triton kernel, or a function that kernels call."""
    # A run-time type checker may have wrapped the function.
    return triton.jit(inspect.unwrap(function))


# --------------------------------------------------------------------------------------------------- one cell


@kernel
def _locate(points, n, here, axis, cells):
    """Find the cell of a point along one axis; see `compiled._locate`. `here` masks lanes without a point."""
    scale = cells.to(points.dtype.element_ty)
    free = tl.load(points + 3 * n + axis, mask=here, other=0.0) * scale
    inner = tl.maximum(free, 0.0, propagate_nan=tl.PropagateNan.ALL)
    position = tl.minimum(inner, scale, propagate_nan=tl.PropagateNan.ALL)
    start = tl.minimum(tl.floor(position), scale - 1.0, propagate_nan=tl.PropagateNan.ALL)
    # NaN gets the first cell; the fraction is NaN, and so is everything that is computed from it.
    cell = tl.where(start > 0.0, start, 0.0).to(tl.uint32)
    return cell, position - start, tl.where(position == free, scale, 0.0)


@kernel
def _row(i, j, k, cells, entries, dense):
    """Return the row of a vertex in the table of its level."""
    step = (cells + 1).to(tl.uint32)
    hashed = (i ^ (j * 2654435761) ^ (k * 805459861)) & (entries - 1).to(tl.uint32)
    return tl.where(dense != 0, i + step * (j + step * k), hashed).to(tl.int64)


@kernel
def _vertices(i, j, k, offset, cells, entries, dense):
    """Return the rows of a cell's eight vertices in the table of all levels."""
    r0 = offset + _row(i, j, k, cells, entries, dense)
    r1 = offset + _row(i + 1, j, k, cells, entries, dense)
    r2 = offset + _row(i, j + 1, k, cells, entries, dense)
    r3 = offset + _row(i + 1, j + 1, k, cells, entries, dense)
    r4 = offset + _row(i, j, k + 1, cells, entries, dense)
    r5 = offset + _row(i + 1, j, k + 1, cells, entries, dense)
    r6 = offset + _row(i, j + 1, k + 1, cells, entries, dense)
    r7 = offset + _row(i + 1, j + 1, k + 1, cells, entries, dense)
    return r0, r1, r2, r3, r4, r5, r6, r7


@kernel
def _corners(column, width, r0, r1, r2, r3, r4, r5, r6, r7, here):
    """Load a feature at the eight vertices; `column` is its address in the first row of the table."""
    c0 = tl.load(column + r0 * width, mask=here, other=0.0)
    c1 = tl.load(column + r1 * width, mask=here, other=0.0)
    c2 = tl.load(column + r2 * width, mask=here, other=0.0)
    c3 = tl.load(column + r3 * width, mask=here, other=0.0)
    c4 = tl.load(column + r4 * width, mask=here, other=0.0)
    c5 = tl.load(column + r5 * width, mask=here, other=0.0)
    c6 = tl.load(column + r6 * width, mask=here, other=0.0)
    c7 = tl.load(column + r7 * width, mask=here, other=0.0)
    return c0, c1, c2, c3, c4, c5, c6, c7


@kernel
def _value_and_slopes(c0, c1, c2, c3, c4, c5, c6, c7, x, y, z):
    """Return the trilinear interpolation, and its derivative along each axis per unit of the cell."""
    z0, z1, z2, z3 = c4 - c0, c5 - c1, c6 - c2, c7 - c3
    b0, b1, b2, b3 = c0 + z * z0, c1 + z * z1, c2 + z * z2, c3 + z * z3
    y0, y1 = b2 - b0, b3 - b1
    left, right = b0 + y * y0, b1 + y * y1
    back, front = z0 + y * (z2 - z0), z1 + y * (z3 - z1)
    return left + x * (right - left), right - left, y0 + x * (y1 - y0), back + x * (front - back)


# ------------------------------------------------------------------------------------------------ the kernels


@kernel
def _interpolate(
    points, table, grid, features, jacobian, count, levels,
    width: tl.constexpr, with_jacobian: tl.constexpr, block: tl.constexpr,
):  # fmt: skip
    n = tl.program_id(0).to(tl.int64) * block + tl.arange(0, block)
    level, here = tl.program_id(1), n < count
    offset, cells = tl.load(grid + level), tl.load(grid + levels + level)
    entries, dense = tl.load(grid + 2 * levels + level), tl.load(grid + 3 * levels + level)
    i, x, dx = _locate(points, n, here, 0, cells)
    j, y, dy = _locate(points, n, here, 1, cells)
    k, z, dz = _locate(points, n, here, 2, cells)
    r0, r1, r2, r3, r4, r5, r6, r7 = _vertices(i, j, k, offset, cells, entries, dense)
    for f in tl.static_range(width):
        c0, c1, c2, c3, c4, c5, c6, c7 = _corners(table + f, width, r0, r1, r2, r3, r4, r5, r6, r7, here)
        value, along_x, along_y, along_z = _value_and_slopes(c0, c1, c2, c3, c4, c5, c6, c7, x, y, z)
        column = (level * width + f).to(tl.int64)
        tl.store(features + column * count + n, value, mask=here)
        if with_jacobian:
            slopes = jacobian + 3 * column * count + n
            tl.store(slopes, along_x * dx, mask=here)
            tl.store(slopes + count, along_y * dy, mask=here)
            tl.store(slopes + 2 * count, along_z * dz, mask=here)


@kernel
def _add_to_table(
    points, grid, features, jacobian, table, count, levels, f_point, f_column, j_point, j_column, j_axis,
    width: tl.constexpr, with_jacobian: tl.constexpr, block: tl.constexpr,
):  # fmt: skip
    n = tl.program_id(0).to(tl.int64) * block + tl.arange(0, block)
    level, here = tl.program_id(1), n < count
    offset, cells = tl.load(grid + level), tl.load(grid + levels + level)
    entries, dense = tl.load(grid + 2 * levels + level), tl.load(grid + 3 * levels + level)
    i, x, dx = _locate(points, n, here, 0, cells)
    j, y, dy = _locate(points, n, here, 1, cells)
    k, z, dz = _locate(points, n, here, 2, cells)
    r0, r1, r2, r3, r4, r5, r6, r7 = _vertices(i, j, k, offset, cells, entries, dense)
    rest_x, rest_y, rest_z = 1.0 - x, 1.0 - y, 1.0 - z
    for f in tl.static_range(width):
        column = level * width + f
        value = tl.load(features + n * f_point + column * f_column, mask=here, other=0.0)
        along_x, along_y, along_z = tl.zeros_like(value), tl.zeros_like(value), tl.zeros_like(value)
        if with_jacobian:
            slopes = jacobian + n * j_point + column * j_column
            along_x = tl.load(slopes, mask=here, other=0.0) * dx
            along_y = tl.load(slopes + j_axis, mask=here, other=0.0) * dy
            along_z = tl.load(slopes + 2 * j_axis, mask=here, other=0.0) * dz
        # The transpose of `_value_and_slopes`: along x, then y, then z.
        left, right = rest_x * value - along_x, x * value + along_x
        b0, b1 = rest_y * left - rest_x * along_y, rest_y * right - x * along_y
        b2, b3 = y * left + rest_x * along_y, y * right + x * along_y
        back, front = rest_x * along_z, x * along_z
        z0, z1, z2, z3 = rest_y * back, rest_y * front, y * back, y * front
        tl.atomic_add(table + r0 * width + f, rest_z * b0 - z0, mask=here, sem="relaxed")
        tl.atomic_add(table + r1 * width + f, rest_z * b1 - z1, mask=here, sem="relaxed")
        tl.atomic_add(table + r2 * width + f, rest_z * b2 - z2, mask=here, sem="relaxed")
        tl.atomic_add(table + r3 * width + f, rest_z * b3 - z3, mask=here, sem="relaxed")
        tl.atomic_add(table + r4 * width + f, z * b0 + z0, mask=here, sem="relaxed")
        tl.atomic_add(table + r5 * width + f, z * b1 + z1, mask=here, sem="relaxed")
        tl.atomic_add(table + r6 * width + f, z * b2 + z2, mask=here, sem="relaxed")
        tl.atomic_add(table + r7 * width + f, z * b3 + z3, mask=here, sem="relaxed")


@kernel
def _point_gradient(
    points, table, grid, features, jacobian, gradient, count, levels,
    f_point, f_column, j_point, j_column, j_axis,
    width: tl.constexpr, with_jacobian: tl.constexpr, block: tl.constexpr,
):  # fmt: skip
    n = tl.program_id(0).to(tl.int64) * block + tl.arange(0, block)
    here = n < count
    to_x = tl.zeros((block,), points.dtype.element_ty)
    to_y, to_z = to_x, to_x
    # A program computes all levels, so the gradient of a point is summed without atomics.
    for level in range(levels):
        offset, cells = tl.load(grid + level), tl.load(grid + levels + level)
        entries, dense = tl.load(grid + 2 * levels + level), tl.load(grid + 3 * levels + level)
        i, x, dx = _locate(points, n, here, 0, cells)
        j, y, dy = _locate(points, n, here, 1, cells)
        k, z, dz = _locate(points, n, here, 2, cells)
        r0, r1, r2, r3, r4, r5, r6, r7 = _vertices(i, j, k, offset, cells, entries, dense)
        for f in tl.static_range(width):
            c0, c1, c2, c3, c4, c5, c6, c7 = _corners(table + f, width, r0, r1, r2, r3, r4, r5, r6, r7, here)
            _, along_x, along_y, along_z = _value_and_slopes(c0, c1, c2, c3, c4, c5, c6, c7, x, y, z)
            column = level * width + f
            value = tl.load(features + n * f_point + column * f_column, mask=here, other=0.0)
            by_x, by_y, by_z = value * along_x, value * along_y, value * along_z
            if with_jacobian:
                slopes = jacobian + n * j_point + column * j_column
                gx = tl.load(slopes, mask=here, other=0.0) * dx
                gy = tl.load(slopes + j_axis, mask=here, other=0.0) * dy
                gz = tl.load(slopes + 2 * j_axis, mask=here, other=0.0) * dz
                # The mixed second derivatives per unit of the cell; the pure ones (xx, yy, zz) are 0.
                low, high = c3 - c2 - c1 + c0, c7 - c6 - c5 + c4
                near, far = c5 - c4 - c1 + c0, c7 - c6 - c3 + c2
                back, front = c6 - c4 - c2 + c0, c7 - c5 - c3 + c1
                xy, xz, yz = low + z * (high - low), near + y * (far - near), back + x * (front - back)
                by_x += gy * xy + gz * xz
                by_y += gx * xy + gz * yz
                by_z += gx * xz + gy * yz
            to_x += by_x * dx
            to_y += by_y * dy
            to_z += by_z * dz
    tl.store(gradient + 3 * n, to_x, mask=here)
    tl.store(gradient + 3 * n + 1, to_y, mask=here)
    tl.store(gradient + 3 * n + 2, to_z, mask=here)


# ------------------------------------------------------------------------------------------------ the backend


def forward(
    x01: Float[Tensor, "N 3"], table: Float[Tensor, "T F"], spec: GridSpec, jacobian: bool
) -> Encoded:
    """See `Kernels`."""
    count, levels = len(x01), len(spec.resolutions)
    features = table.new_empty(spec.width, count)
    slopes = table.new_empty(spec.width, 3, count if jacobian else 0)
    with torch.cuda.device_of(x01):
        _interpolate[_blocks(count), levels](
            x01,
            table,
            _grid(spec, x01.device),
            features,
            slopes,
            count,
            levels,
            spec.features,
            jacobian,
            BLOCK,
            **FUSED,
        )
    return Encoded(features.t(), slopes.permute(2, 0, 1) if jacobian else None)


def table_gradient(
    x01: Float[Tensor, "N 3"], spec: GridSpec, gradients: OutputGradients
) -> Float[Tensor, "T F"]:
    """See `Kernels`."""
    table = x01.new_zeros(spec.entries, spec.features)
    count, levels = len(x01), len(spec.resolutions)
    features, jacobian = gradients.features, _jacobian(gradients)
    with torch.cuda.device_of(x01):
        _add_to_table[_blocks(count), levels](
            x01, _grid(spec, x01.device), features, jacobian, table, count, levels,
            *features.stride(), *jacobian.stride(),
            spec.features, gradients.jacobian is not None, BLOCK, **FUSED,
        )  # fmt: skip
    return table


def point_gradient(
    x01: Float[Tensor, "N 3"], table: Float[Tensor, "T F"], spec: GridSpec, gradients: OutputGradients
) -> Float[Tensor, "N 3"]:
    """See `Kernels`."""
    gradient = torch.empty_like(x01)
    count, levels = len(x01), len(spec.resolutions)
    features, jacobian = gradients.features, _jacobian(gradients)
    with torch.cuda.device_of(x01):
        _point_gradient[(_blocks(count),)](
            x01, table, _grid(spec, x01.device), features, jacobian, gradient, count, levels,
            *features.stride(), *jacobian.stride(),
            spec.features, gradients.jacobian is not None, BLOCK, **FUSED,
        )  # fmt: skip
    return gradient


def _blocks(count: int) -> int:
    # Triton does not launch 0 programs.
    return max(1, triton.cdiv(count, BLOCK))


def _jacobian(gradients: OutputGradients) -> Float[Tensor, "M F 3"]:
    """The gradient of the Jacobian; an empty tensor if there is none."""
    return gradients.features.new_empty(0, 0, 3) if gradients.jacobian is None else gradients.jacobian


@lru_cache(maxsize=32)
def _grid(spec: GridSpec, device: torch.device) -> Int[Tensor, "4 L"]:
    """Four numbers per level: first table row, cells along an edge, number of rows, and whether each vertex
    has its own row.
    """
    dense = [spec.is_dense(level) for level in range(len(spec.resolutions))]
    rows = [spec.offsets[:-1], spec.resolutions, spec.entries_per_level, dense]
    return torch.tensor([list(map(int, row)) for row in rows], device=device)


KERNELS = Kernels(
    ("cuda", "cpu") if os.environ.get("TRITON_INTERPRET") == "1" else ("cuda",),
    forward,
    table_gradient,
    point_gradient,
)
