"""The true light of a capture as a function: the radiance that arrives at its surface points from any
direction.

The truth is known along 4096 directions per point. Between them it is interpolated on a grid with one vertex
per direction, so that sums over any number of directions estimate the same integral.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch
from jaxtyping import Float
from scipy.spatial import cKDTree
from torch import Tensor

from neilfpp_method.data.capture import load_capture
from neilfpp_method.data.truth import LightField, Truth
from neilfpp_method.errors import UserError

__all__ = ["TrueLight", "read_light", "true_light"]

ROWS, COLUMNS = 64, 128  # over the sphere; half of it is above the horizon: 4096


@dataclass(frozen=True)
class TrueLight:
    """Radiance on a grid of equal steps in z and in azimuth, a grid for each of N points."""

    grid: Float[Tensor, "N R C 3"]

    def radiance(self, wi: Float[Tensor, "N S 3"]) -> Float[Tensor, "N S 3"]:
        """Linear RGB that arrives at the points from wi; below the horizon, that of the nearest known
        direction.
        """
        rows, columns = self.grid.shape[1:3]
        x, y, z = wi.unbind(-1)
        row = ((1 - z) * (rows / 2) - 0.5).clamp(0, rows - 1)
        column = torch.atan2(y, x) / (2 * math.pi) % 1 * columns - 0.5
        upper, left = row.floor().clamp_max(rows - 2), column.floor()
        down, right = (row - upper)[..., None], (column - left)[..., None]
        flat = self.grid.flatten(1, 2)

        def at(r: Tensor, c: Tensor) -> Tensor:
            index = (r * columns + c % columns).long()[..., None].expand(*wi.shape)
            return flat.gather(1, index)

        above = torch.lerp(at(upper, left), at(upper, left + 1), right)
        below = torch.lerp(at(upper + 1, left), at(upper + 1, left + 1), right)
        return torch.lerp(above, below, down)

    def directions(self) -> Float[Tensor, "R C 3"]:
        """Where the vertices of the grid lie."""
        return cell_directions(*self.grid.shape[1:3], self.grid)

    def __getitem__(self, points: Tensor | slice) -> TrueLight:
        """The light of some of the points, in their order."""
        return TrueLight(self.grid[points])


def true_light(wi: Float[Tensor, "N S 3"], radiance: Float[Tensor, "N S 3"]) -> TrueLight:
    """The function that radiance known along wi stands for: each vertex takes that of the nearest
    direction.
    """
    vertices = cell_directions(ROWS, COLUMNS, wi).reshape(-1, 3).numpy()
    nearest = np.stack([cKDTree(known).query(vertices)[1] for known in wi.numpy()])
    index = torch.from_numpy(nearest)[..., None].expand(-1, -1, 3)
    return TrueLight(radiance.gather(1, index).unflatten(1, (ROWS, COLUMNS)))


def read_light(capture: Path) -> LightField:
    """The true light field of a capture.

    Raises:
        UserError: the capture has none.
    """
    field = Truth(load_capture(capture)).light_field()
    if field is None:
        raise UserError(f"{capture}: no light/light_field_gt.npz", "choose a capture whose light is known")
    return field


def cell_directions(rows: int, columns: int, like: Tensor) -> Float[Tensor, "R C 3"]:
    """The middles of cells of equal solid angle: rows of equal height about +z, columns of equal azimuth from
    +x towards +y.
    """
    i = torch.arange(rows, device=like.device, dtype=like.dtype)
    j = torch.arange(columns, device=like.device, dtype=like.dtype)
    z = (1 - 2 * (i[:, None] + 0.5) / rows).expand(rows, columns)
    azimuth = 2 * math.pi * (j + 0.5) / columns
    sine = ((1 - z) * (1 + z)).clamp_min(0).sqrt()
    return torch.stack((sine * azimuth.cos(), sine * azimuth.sin(), z), -1)
