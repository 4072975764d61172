"""A density of directions in a table: what a light that is known roughly contributes to importance sampling.

The sphere is cut into `rows` of equal height about +z and `columns` of equal azimuth, so that all cells have the same
solid angle, 4π/(rows · columns). Cell (i, j) lies between z = 1 − 2i/rows and 1 − 2(i + 1)/rows, and between the azimuths
2πj/columns and 2π(j + 1)/columns, from +x towards +y. The density is constant on a cell.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import torch
from jaxtyping import Float, Int
from torch import Tensor

from neilfpp_method.shading.frame import at_least_float32

__all__ = ["DirectionTable", "cell_directions", "with_cosine"]


@dataclass(frozen=True)
class DirectionTable:
    """Weights ≥ 0 of the cells, not normalised: one table for each point (N, rows, columns), or one for all (1, …).

    A table without weight anywhere is an even one.
    """

    weights: Float[Tensor, "N R C"]

    @torch.no_grad()
    def draw(self, u: Float[Tensor, "M S"], v: Float[Tensor, "M S"]) -> Float[Tensor, "M S 3"]:
        """Directions for points of the unit square: u picks the row and the height in it, v the column and the azimuth.

        Both maps keep the order of their argument, so an even spread of (u, v) stays one. M = N, or any for one table.
        """
        rows, columns = self.weights.shape[1:]
        shares = self._shares().expand(len(u), -1, -1)
        row, height = _invert(shares.sum(2)[:, None].expand(-1, u.shape[1], -1), u)
        index = torch.arange(len(u), device=u.device)[:, None]
        column, turn = _invert(shares[index, row], v)
        z = 1 - 2 * (row + height) / rows
        azimuth = 2 * math.pi * (column + turn) / columns
        return _on_sphere(z, azimuth)

    @torch.no_grad()
    def pdf(self, wi: Float[Tensor, "M S 3"]) -> Float[Tensor, "M S"]:
        """Density of `draw` for (u, v) even on the unit square, per steradian."""
        rows, columns = self.weights.shape[1:]
        x, y, z = wi.unbind(-1)
        turn = torch.atan2(y, x) / (2 * math.pi)
        row = ((1 - z) * (rows / 2)).long().clamp(0, rows - 1)
        column = ((turn - turn.floor()) * columns).long().clamp(0, columns - 1)
        density = self._shares().flatten(1) * (rows * columns / (4 * math.pi))
        return density.expand(len(wi), -1).gather(1, row * columns + column)

    def _shares(self) -> Float[Tensor, "N R C"]:
        weights = at_least_float32(self.weights)
        total = weights.sum((1, 2), keepdim=True)
        return torch.where(total > 0, weights / total.clamp_min(torch.finfo(total.dtype).tiny), 1 / weights[0].numel())


def cell_directions(rows: int, columns: int, like: Tensor) -> Float[Tensor, "R C 3"]:
    """The middles of the cells of a table, on the device and of the type of `like`."""
    i = torch.arange(rows, device=like.device, dtype=like.dtype)
    j = torch.arange(columns, device=like.device, dtype=like.dtype)
    z, azimuth = 1 - 2 * (i[:, None] + 0.5) / rows, 2 * math.pi * (j + 0.5) / columns
    return _on_sphere(z.expand(rows, columns), azimuth.expand(rows, columns))


def with_cosine(weights: Float[Tensor, "#N R C"], n: Float[Tensor, "N 3"]) -> DirectionTable:
    """The table of weights · max(n·wi, 0): light as it falls on surfaces with unit normals n.

    A cell that the horizon crosses keeps a share: the cosine at its middle is raised by the sine of the radius of a disc
    of the cell's solid angle, which bounds it over that disc.
    """
    rows, columns = weights.shape[1:]
    cosine = torch.einsum("rck,nk->nrc", cell_directions(rows, columns, n), n)
    radius = math.acos(1 - 2 / (rows * columns))
    return DirectionTable(weights * (cosine + math.sin(radius)).clamp_min(0))


def _invert(shares: Float[Tensor, "M S K"], u: Float[Tensor, "M S"]) -> tuple[Int[Tensor, "M S"], Float[Tensor, "M S"]]:
    """Which of K shares a number falls into, and how far: the inverse of the cumulated shares, made to end at 1."""
    cumulated = shares.cumsum(-1)
    scaled = u * cumulated[..., -1]
    found = torch.searchsorted(cumulated, scaled[..., None], right=True).clamp_max(shares.shape[-1] - 1)
    share, end = shares.gather(-1, found)[..., 0], cumulated.gather(-1, found)[..., 0]
    within = 1 - (end - scaled) / share.clamp_min(torch.finfo(share.dtype).tiny)
    return found[..., 0], within.clamp(0, 1)


def _on_sphere(z: Float[Tensor, "*B"], azimuth: Float[Tensor, "*B"]) -> Float[Tensor, "*B 3"]:
    sine = ((1 - z) * (1 + z)).clamp_min(0).sqrt()
    return torch.stack((sine * azimuth.cos(), sine * azimuth.sin(), z), -1)
