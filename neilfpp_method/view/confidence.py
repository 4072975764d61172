"""The expected error of the material everywhere on a surface, from some thousand points of it.

An expected error takes as long as shading a point for each of its views (`evaluate.confidence`). It varies
slowly over the surface, so the viewer interpolates it between points that are spread over the surface.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Float
from scipy.spatial import cKDTree
from torch import Tensor

from neilfpp_method.evaluate.confidence import deviations_at
from neilfpp_method.relight.surface import Surface
from neilfpp_method.shading.frame import safe_normalize
from neilfpp_method.structures import OrientedPoints
from neilfpp_method.train.run import Run

__all__ = ["ExpectedErrors", "expected_errors", "points_on"]

POINTS = 3000
"""Number of points at which the errors are computed. On a recovered table top one thread takes 10 s for them.
"""
NEAREST = 4
"""Number of points between which the errors are interpolated."""
TURN = 0.1
"""Distance, scene units, that one radian between two normals adds, so that the two sides of a thin plate are
not mixed.
"""
TINY = 1e-6
"""Added to distances, scene units, so that their inverse is finite."""


@dataclass(frozen=True)
class ExpectedErrors:
    """Expected errors at P points of a surface.

    Attributes:
        tree: positions, scene frame, and `TURN` times the normals of the points.
        values: expected errors at the points; the columns are base colour, roughness, metallic.
    """

    tree: cKDTree
    values: Float[Tensor, "P 3"]

    def at(self, position: Float[Tensor, "N 3"], normal: Float[Tensor, "N 3"]) -> Float[Tensor, "N 3"]:
        """Interpolate the errors at points of the surface, by the inverse distance to the nearest points."""
        distance, number = self.tree.query(_coordinates(position, normal), k=min(NEAREST, self.tree.n))
        weight = 1 / (torch.from_numpy(distance).float().view(len(position), -1) + TINY)
        weight = (weight / weight.sum(-1, keepdim=True)).to(self.values)
        values = self.values[torch.from_numpy(number).to(self.values.device)].view(len(position), -1, 3)
        return (weight[..., None] * values).sum(1)


def expected_errors(run: Run, surface: Surface) -> ExpectedErrors:
    """Compute the expected errors of a run's material at `POINTS` points of its surface.

    Raises:
        UserError: a training view cannot be read.
    """
    points = points_on(surface, POINTS)
    return ExpectedErrors(cKDTree(_coordinates(points.position, points.normal)), deviations_at(run, points))


def points_on(surface: Surface, count: int) -> OrientedPoints:
    """Draw points on a surface, uniform by area, with shading normals. The same for each call."""
    device = surface.triangles.device
    generator = torch.Generator().manual_seed(0)
    a, b, c = surface.triangles.cpu().unbind(1)
    area = torch.linalg.cross(b - a, c - a).norm(dim=-1)
    # `torch.multinomial` has a limit of 2^24 categories, which a large mesh may exceed.
    area = area.double().cumsum(0)
    number = torch.searchsorted(area, area[-1] * torch.rand(count, generator=generator, dtype=torch.double))
    u, v = torch.rand(count, 1, generator=generator).sqrt(), torch.rand(count, 1, generator=generator)
    weights = torch.cat((1 - u, u * (1 - v), u * v), -1)[..., None]
    position = (weights * surface.triangles.cpu()[number]).sum(1)
    normal = safe_normalize((weights * surface.corner_normals.cpu()[number]).sum(1))
    return OrientedPoints(position.to(device), normal.to(device))


def _coordinates(position: Float[Tensor, "N 3"], normal: Float[Tensor, "N 3"]) -> Float[np.ndarray, "N 6"]:
    return torch.cat((position, TURN * normal), -1).cpu().numpy()
