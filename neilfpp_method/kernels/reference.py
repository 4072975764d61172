"""Hash-grid encoding in plain torch: any device, any float dtype, any order of differentiation.

For each level, the eight table rows around a point are interpolated trilinearly along z, then y, then x. The
Jacobian is computed from the same rows, with the difference of two neighbours instead of their interpolation
along one axis. The points are the last axis of every intermediate tensor, so that each operation runs over
contiguous memory; processing one level at a time keeps the tensors in the cache.

Table rows are gathered and scattered by a pair of functions that are each other's derivative. The scatter
processes the features in parallel but the points in order, so that results on a CPU are bitwise reproducible.
"""

from __future__ import annotations

import torch
from jaxtyping import Float, Int
from torch import Tensor
from torch.autograd.function import FunctionCtx

from neilfpp_method.kernels.grid import Encoded, GridSpec

__all__ = ["encode"]

PRIMES = (1, 2654435761 - 2**32, 805459861)
"""Factors of the spatial hash. The second one is the int32 with the same bits as the published uint32."""


def encode(x01: Float[Tensor, "N 3"], table: Float[Tensor, "T F"], spec: GridSpec, jacobian: bool) -> Encoded:
    """See `neilfpp_method.kernels.encode`."""
    # With less precision than float32, a coordinate could not distinguish the cells of a fine level.
    x01 = x01.to(torch.promote_types(x01.dtype, torch.float32))
    points = x01.t().clamp(0, 1).contiguous()
    inside = ((x01 >= 0) & (x01 <= 1)).t().to(table.dtype)
    features, jacobians = [], []
    for level, rows in enumerate(table.split(spec.entries_per_level)):
        resolution = spec.resolutions[level]
        scaled = points * resolution
        cell = scaled.detach().to(torch.int32).clamp_(0, resolution - 1)
        fraction = (scaled - cell).to(table.dtype)
        corners = _Gather.apply(rows, _vertex_rows(cell, resolution, rows.shape[0], spec.is_dense(level)))
        if jacobian:
            value, slopes = _value_and_slopes(corners, fraction)
            jacobians.append(slopes * (inside * resolution)[:, None])
        else:
            value = _value(corners, fraction)
        features.append(value)
    return Encoded(torch.cat(features).t(), torch.cat(jacobians, 1).permute(2, 1, 0) if jacobian else None)


def _vertex_rows(
    cell: Int[Tensor, "3 N"], resolution: int, entries: int, dense: bool
) -> Int[Tensor, "2 2 2 N"]:
    """The table rows of a cell's eight vertices; the first three axes choose its end in x, y, z."""
    factors = (1, resolution + 1, (resolution + 1) ** 2) if dense else PRIMES
    x, y, z = (torch.stack((c, c + 1)) * factor for c, factor in zip(cell, factors, strict=True))
    x, y = x[:, None, None], y[:, None]
    return x + y + z if dense else (x ^ y ^ z).bitwise_and_(entries - 1)


def _value(corners: Float[Tensor, "F 2 2 2 N"], fraction: Float[Tensor, "3 N"]) -> Float[Tensor, "F N"]:
    """Trilinear interpolation."""
    x, y, z = fraction
    at_z = torch.lerp(*corners.unbind(3), z)
    at_yz = torch.lerp(*at_z.unbind(2), y)
    return torch.lerp(*at_yz.unbind(1), x)


def _value_and_slopes(
    corners: Float[Tensor, "F 2 2 2 N"], fraction: Float[Tensor, "3 N"]
) -> tuple[Float[Tensor, "F N"], Float[Tensor, "3 F N"]]:
    """Trilinear interpolation, and its derivative along x, y, z in units of the cell."""
    x, y, z = fraction
    back, front = corners.unbind(3)
    low, high = torch.lerp(back, front, z).unbind(2)
    left, right = torch.lerp(low, high, y).unbind(1)
    along_y = torch.lerp(*(high - low).unbind(1), x)
    along_z = torch.lerp(*torch.lerp(*(front - back).unbind(2), y).unbind(1), x)
    return torch.lerp(left, right, x), torch.stack((right - left, along_y, along_z))


class _Gather(torch.autograd.Function):
    """Gather table rows by index; the features become the first axis."""

    @staticmethod
    def forward(
        ctx: FunctionCtx, table: Float[Tensor, "T F"], rows: Int[Tensor, "2 2 2 N"]
    ) -> Float[Tensor, "F 2 2 2 N"]:
        ctx.save_for_backward(rows)
        ctx.entries = table.shape[0]
        return table.index_select(0, rows.reshape(-1)).t().contiguous().view(table.shape[1], *rows.shape)

    @staticmethod
    def backward(ctx: FunctionCtx, values: Float[Tensor, "F 2 2 2 N"]) -> tuple[Float[Tensor, "T F"], None]:
        (rows,) = ctx.saved_tensors
        return _Scatter.apply(values, rows, ctx.entries), None


class _Scatter(torch.autograd.Function):
    """The transpose of `_Gather`: add values to their table rows."""

    @staticmethod
    def forward(
        ctx: FunctionCtx, values: Float[Tensor, "F 2 2 2 N"], rows: Int[Tensor, "2 2 2 N"], entries: int
    ) -> Float[Tensor, "entries F"]:
        ctx.save_for_backward(rows)
        index = rows.reshape(1, -1).long().expand(values.shape[0], -1)
        sums = values.new_zeros(values.shape[0], entries)
        # One sequential pass per feature; `index_add_` over rows takes several times as long.
        return sums.scatter_add_(1, index, values.reshape(index.shape)).t().contiguous()

    @staticmethod
    def backward(
        ctx: FunctionCtx, table: Float[Tensor, "T F"]
    ) -> tuple[Float[Tensor, "F 2 2 2 N"], None, None]:
        (rows,) = ctx.saved_tensors
        return _Gather.apply(table, rows), None, None
