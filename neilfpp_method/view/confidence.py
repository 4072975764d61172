"""The expected error of the material everywhere on a surface, from some thousand points of it.

An expected error takes as long as shading a point for each of its views (`evaluate.confidence`). It varies
slowly over the surface, so the viewer interpolates it between points that are spread over the surface.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch
import trimesh
from jaxtyping import Float
from scipy.spatial import cKDTree
from torch import Tensor

from neilfpp_method.data.kd_tree import kd_tree
from neilfpp_method.evaluate.confidence import coordinates, deviations_at
from neilfpp_method.relight.surface import Surface
from neilfpp_method.shading.frame import safe_normalize
from neilfpp_method.structures import OrientedPoints
from neilfpp_method.train.run import Run

__all__ = ["ExpectedErrors", "expected_errors", "points_on"]

POINTS = 3000
"""Number of points at which the errors are computed."""
NEAREST = 4
"""Number of points between which the errors are interpolated."""
TINY = 1e-6
"""Added to distances, scene units, so that their inverse is finite."""


@dataclass(frozen=True)
class ExpectedErrors:
    """Expected errors at P points of a surface.

    Attributes:
        tree: `coordinates` of the points.
        values: expected errors at the points; the columns are base colour, roughness, metallic.
    """

    tree: cKDTree
    values: Float[Tensor, "P 3"]

    def at(self, position: Float[Tensor, "N 3"], normal: Float[Tensor, "N 3"]) -> Float[Tensor, "N 3"]:
        """Interpolate the errors at points of the surface, by the inverse distance to the nearest points."""
        distance, number = self.tree.query(coordinates(position, normal), k=min(NEAREST, self.tree.n))
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
    return ExpectedErrors(kd_tree(coordinates(points.position, points.normal)), deviations_at(run, points))


def points_on(surface: Surface, count: int) -> OrientedPoints:
    """Draw points on a surface, uniform by area, with shading normals. The same for each call."""
    triangles = surface.triangles.cpu()
    mesh = trimesh.Trimesh(
        triangles.reshape(-1, 3), np.arange(3 * len(triangles)).reshape(-1, 3), process=False
    )
    sampled, number = trimesh.sample.sample_surface(mesh, count, seed=0)
    weights = trimesh.triangles.points_to_barycentric(mesh.triangles[number], sampled)
    weights = torch.from_numpy(weights).float()[..., None]
    position = (weights * triangles[number]).sum(1)
    normal = safe_normalize((weights * surface.corner_normals.cpu()[number]).sum(1))
    return OrientedPoints(position, normal).to(surface.triangles.device)
