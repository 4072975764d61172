"""Other viewpoints of hits, from which a correct host sees the same surface points."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from jaxtyping import Float
from torch import Tensor
from torch.nn.functional import normalize

from neilfpp_method.structures import OrientedPoints, RayBatch

__all__ = ["SAME_POINT", "START_DISTANCE", "OtherViewpoints", "other_viewpoints"]

SAME_POINT = 0.01
"""Largest distance between the hits of one point from two viewpoints, scene units."""
START_DISTANCE = 0.05
"""Distance from a point at which rays start in the search for a near plane, scene units."""
VIEWPOINT_TANGENT = 0.6
"""Tangent of the angle between the other viewpoint and the direction halfway between normal and viewer."""


@dataclass(frozen=True)
class OtherViewpoints:
    """Surface points, each with the direction to another viewpoint.

    Attributes:
        position: the points, scene frame.
        distance: distance from each point to the origin of the ray that hit it, scene units.
        direction: unit vector from each point to its other viewpoint.
    """

    position: Float[Tensor, "N 3"]
    distance: Float[Tensor, " N"]
    direction: Float[Tensor, "N 3"]

    def rays(self, distance: Float[Tensor, " N"]) -> RayBatch:
        """Rays to the points that start at these distances from them, on the side of the other viewpoints."""
        return RayBatch(self.position + distance[:, None] * self.direction, -self.direction)


def other_viewpoints(rays: RayBatch, points: OrientedPoints) -> OtherViewpoints:
    """Choose another viewpoint for each hit; a few of them may be behind another surface.

    Args:
        rays: the rays that hit, scene frame.
        points: position and outward unit normal of the hit of each ray.
    """
    to_viewer = -rays.directions
    tangent = normalize(torch.linalg.cross(points.normal, to_viewer.roll(1, dims=-1)), dim=-1)
    return OtherViewpoints(
        position=points.position,
        distance=(points.position - rays.origins).norm(dim=-1),
        direction=normalize(points.normal + to_viewer + VIEWPOINT_TANGENT * tangent, dim=-1),
    )
