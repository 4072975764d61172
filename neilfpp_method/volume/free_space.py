"""Free space around cameras: a ball around every camera that contains no density.

A single view is explained as well by fog in front of its camera as by the surface that it shows. If cameras
are inside the space that may have density, training finds the fog first. So a ball around every camera is cut
out of the scene, for the rays of all views: new views, which are among the others, see no fog either.
"""

from __future__ import annotations

from dataclasses import dataclass

import torch
from jaxtyping import Float
from torch import Tensor, nn

__all__ = ["FREE_SHARE", "OBJECT_RADIUS", "FreeSpace", "FreeSpaceSample", "cameras_within", "free_radius"]

FREE_SHARE = 0.25
"""Radius of the ball around a camera, relative to its distance from the scene's center: 0.45 scene units for
a camera at 1.8, the median distance if the scene box was determined by what the cameras look at.
"""
OBJECT_RADIUS = 1.0
"""Radius of the ball that contains the object, scene units; no free ball reaches into it."""
RESOLUTION = 64
"""Vertices along an edge of the grid that stores the decisive camera of each place."""


@dataclass(frozen=True)
class FreeSpaceSample:
    """Depth of N points in free space, scene units, negative outside of it, and its unit gradient."""

    depth: Float[Tensor, " N"]
    gradient: Float[Tensor, "N 3"]


def free_radius(distance: Float[Tensor, " V"]) -> Float[Tensor, " V"]:
    """Radius of the free balls of cameras at a distance from the scene's center.

    It is the smaller of `FREE_SHARE` · distance and distance − `OBJECT_RADIUS`, and at least 0.

    >>> free_radius(torch.tensor([0.5, 1.2, 2.0])).tolist()
    [0.0, 0.20000004768371582, 0.5]
    """
    return torch.minimum(FREE_SHARE * distance, distance - OBJECT_RADIUS).clamp_min(0.0)


def cameras_within(position: Float[Tensor, "V 3"], radius: float) -> Float[Tensor, "K 3"]:
    """Positions of the cameras whose free balls reach into the scene sphere.

    Args:
        position: camera positions, scene frame.
        radius: radius of the scene sphere, scene units.
    """
    distance = position.norm(dim=-1)
    free = free_radius(distance)
    return position[(free > 0) & (distance - free < radius)]


class FreeSpace(nn.Module):
    """The union of the free balls as a signed depth: max over cameras c of free_radius(‖c‖) − ‖x − c‖.

    The camera of the maximum is looked up at the closest vertex of a grid; the depth for this camera is
    exact. Where two balls meet, the depth is too small by at most one and a half cells.

    Args:
        cameras: camera positions, scene frame; at least one.
        radius: radius of the scene sphere, half an edge of the grid.
    """

    def __init__(self, cameras: Float[Tensor, "V 3"], radius: float) -> None:
        super().__init__()
        self.radius = radius
        # Not in checkpoints: the cameras come from the capture.
        self.register_buffer("cameras", cameras, persistent=False)
        self.register_buffer("free", free_radius(cameras.norm(dim=-1)), persistent=False)
        axis = torch.linspace(-radius, radius, RESOLUTION, dtype=cameras.dtype, device=cameras.device)
        planes = [self._deepest(torch.cartesian_prod(x[None], axis, axis)) for x in axis]
        self.register_buffer(
            "deepest", torch.stack(planes).view(RESOLUTION, RESOLUTION, RESOLUTION), persistent=False
        )

    def forward(self, x: Float[Tensor, "N 3"]) -> FreeSpaceSample:
        """Depth and gradient at points; outside of the grid, its closest vertex determines the camera."""
        x = x.detach()
        place = ((x / self.radius + 1.0) * (0.5 * (RESOLUTION - 1))).round().long().clamp(0, RESOLUTION - 1)
        camera = self.deepest[place[:, 0], place[:, 1], place[:, 2]]
        away = x - self.cameras[camera]
        distance = away.square().sum(-1).clamp_min(1e-12).sqrt()
        return FreeSpaceSample(self.free[camera] - distance, -away / distance[:, None])

    def _deepest(self, x: Float[Tensor, "P 3"]) -> Tensor:
        return (self.free - torch.cdist(x, self.cameras)).argmax(dim=-1)
