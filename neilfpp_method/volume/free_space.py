"""Free space around cameras: a ball around every camera that contains no density.

A single view is explained as well by fog in front of its camera as by the surface that it shows. If cameras
are inside the space that may have density, training finds the fog first. So a ball around every camera is cut
out of the scene, for the rays of all views: new views from among the cameras then show no fog either. A point
cloud determines the size of the balls, because nothing of the scene is much closer to a camera than the
closest points.
"""

from __future__ import annotations

from dataclasses import dataclass

import torch
from jaxtyping import Float
from torch import Tensor, nn

__all__ = ["FREE_SHARE", "OBJECT_RADIUS", "FreeBalls", "FreeSpace", "FreeSpaceSample", "free_balls"]

FREE_SHARE = 0.25
"""Radius of the ball around a camera without a point cloud, relative to its distance from the scene's centre:
0.45 scene units for a camera at 1.8, the median distance if the scene box was computed from the focus of the
cameras.
"""
CLEAR_SHARE = 0.8
"""Radius of the ball around a camera relative to its distance from the closest points of a cloud."""
CLOSEST_SHARE = 1e-3
"""Share of the points that are treated as outliers: they may be closer to a camera than "the closest points".
"""
MEASURED_POINTS = 100_000
"""Maximum number of points whose distances from the cameras are computed."""
OBJECT_RADIUS = 1.0
"""Radius of the ball that contains the object, scene units; no free ball reaches into it."""
RESOLUTION = 64
"""Vertices along an edge of the grid, which stores for each vertex the ball that is deepest there."""


@dataclass(frozen=True)
class FreeBalls:
    """Balls that contain no density: centres in the scene frame and radii in scene units."""

    center: Float[Tensor, "K 3"]
    radius: Float[Tensor, " K"]


@dataclass(frozen=True)
class FreeSpaceSample:
    """Depth of N points in free space, scene units, negative outside of it, and its unit gradient."""

    depth: Float[Tensor, " N"]
    gradient: Float[Tensor, "N 3"]


def free_balls(
    cameras: Float[Tensor, "V 3"], points: Float[Tensor, "P 3"] | None, radius: float
) -> FreeBalls | None:
    """The free balls of cameras that reach into the scene sphere; None if there is none.

    The radius of a ball is `CLEAR_SHARE` of the distance to the closest points, without points `FREE_SHARE`
    of the distance to the scene's centre. It is at most that distance − `OBJECT_RADIUS`.

    Args:
        cameras: camera positions, scene frame.
        points: a point cloud of the scene, scene frame; None if there is none.
        radius: radius of the scene sphere, scene units.

    Example:
        >>> cameras = torch.tensor([[0.5, 0.0, 0.0], [1.2, 0.0, 0.0], [2.0, 0.0, 0.0], [9.0, 0.0, 0.0]])
        >>> free_balls(cameras, None, radius=1.75).radius.tolist()
        [0.20000004768371582, 0.5]
    """
    distance = cameras.norm(dim=-1)
    if points is None or not len(points):
        clear = FREE_SHARE * distance
    else:
        points = points[:: -(-len(points) // MEASURED_POINTS)]
        closest = [(points - camera).norm(dim=-1).quantile(CLOSEST_SHARE) for camera in cameras]
        clear = CLEAR_SHARE * torch.stack(closest)
    free = torch.minimum(clear, distance - OBJECT_RADIUS).clamp_min(0.0)
    within = (free > 0) & (distance - free < radius)
    return FreeBalls(cameras[within], free[within]) if within.any() else None


class FreeSpace(nn.Module):
    """The union of free balls as a signed depth: max over balls of radius − ‖x − centre‖.

    The ball of the maximum is looked up at the closest vertex of a grid; the depth for this ball is exact.
    Where two balls meet, the depth is too small by at most one and a half cells.

    Args:
        balls: the balls; at least one.
        radius: radius of the scene sphere, half an edge of the grid.
    """

    def __init__(self, balls: FreeBalls, radius: float) -> None:
        super().__init__()
        self.radius = radius
        # Not in checkpoints: the cameras and the points come from the capture.
        self.register_buffer("center", balls.center, persistent=False)
        self.register_buffer("free", balls.radius, persistent=False)
        axis = torch.linspace(-radius, radius, RESOLUTION).to(balls.center)
        planes = [self._deepest(torch.cartesian_prod(x[None], axis, axis)) for x in axis]
        self.register_buffer(
            "deepest", torch.stack(planes).view(RESOLUTION, RESOLUTION, RESOLUTION), persistent=False
        )

    def forward(self, x: Float[Tensor, "N 3"]) -> FreeSpaceSample:
        """Depth and gradient at points; outside of the grid, its closest vertex determines the ball."""
        x = x.detach()
        place = ((x / self.radius + 1.0) * (0.5 * (RESOLUTION - 1))).round().long().clamp(0, RESOLUTION - 1)
        ball = self.deepest[place[:, 0], place[:, 1], place[:, 2]]
        away = x - self.center[ball]
        distance = away.square().sum(-1).clamp_min(1e-12).sqrt()
        return FreeSpaceSample(self.free[ball] - distance, -away / distance[:, None])

    def _deepest(self, x: Float[Tensor, "P 3"]) -> Tensor:
        return (self.free - torch.cdist(x, self.center)).argmax(dim=-1)
