"""Free space before cameras: where a camera stands, and some way around it, there is nothing.

A view alone is explained as well by a veil before its own lens as by the surface that it shows, and where
cameras stand within the space that may hold density, training finds veils first. So a ball about every camera
is cut out of the scene, whoever's ray runs through it: new views, which stand among the others, see no veil
either.
"""

from __future__ import annotations

from dataclasses import dataclass

import torch
from jaxtyping import Float
from torch import Tensor, nn

__all__ = ["FREE_SHARE", "OBJECT_RADIUS", "FreeSpace", "FreeSpaceSample", "cameras_within", "free_radius"]

FREE_SHARE = 0.25
"""Radius of the ball about a camera, in its distance from the scene's centre: 0.45 scene units for a camera
that is 1.8 away, as half of them are where the box is about what they look at.
"""
OBJECT_RADIUS = 1.0
"""No ball reaches into the ball of this radius, scene units, which holds the object."""
RESOLUTION = 64
"""Vertices along an edge of the grid that says which camera's ball counts."""


@dataclass(frozen=True)
class FreeSpaceSample:
    """Depth of N points within free space, scene units, negative outside, and its unit gradient."""

    depth: Float[Tensor, " N"]
    gradient: Float[Tensor, "N 3"]


def free_radius(distance: Float[Tensor, " V"]) -> Float[Tensor, " V"]:
    """Radius of the free ball about cameras at a distance from the scene's centre; 0 among the objects.

    The lesser of `FREE_SHARE` · distance and distance − `OBJECT_RADIUS`, and never negative.

    >>> free_radius(torch.tensor([0.5, 1.2, 2.0])).tolist()
    [0.0, 0.20000004768371582, 0.5]
    """
    return torch.minimum(FREE_SHARE * distance, distance - OBJECT_RADIUS).clamp_min(0.0)


def cameras_within(position: Float[Tensor, "V 3"], radius: float) -> Float[Tensor, "K 3"]:
    """The cameras whose free balls reach into a scene of this radius; the others leave it as it is.

    Args:
        position: of cameras, scene frame.
        radius: of the scene sphere, scene units.
    """
    distance = position.norm(dim=-1)
    free = free_radius(distance)
    return position[(free > 0) & (distance - free < radius)]


class FreeSpace(nn.Module):
    """The union of the free balls, as a signed depth: max over cameras c of free_radius(‖c‖) − ‖x − c‖.

    Which camera the maximum comes from is looked up, at the nearest vertex of a grid; the depth is that of
    this camera, exactly. Where two balls meet it is too small by at most a cell and a half.

    Args:
        cameras: positions, scene frame; at least one.
        radius: of the scene sphere, half an edge of the grid.
    """

    def __init__(self, cameras: Float[Tensor, "V 3"], radius: float) -> None:
        super().__init__()
        self.radius = radius
        # Not stored: a run's capture has its cameras.
        self.register_buffer("cameras", cameras, persistent=False)
        self.register_buffer("free", free_radius(cameras.norm(dim=-1)), persistent=False)
        axis = torch.linspace(-radius, radius, RESOLUTION, dtype=cameras.dtype, device=cameras.device)
        planes = [self._deepest(torch.cartesian_prod(x[None], axis, axis)) for x in axis]
        self.register_buffer(
            "deepest", torch.stack(planes).view(RESOLUTION, RESOLUTION, RESOLUTION), persistent=False
        )

    def forward(self, x: Float[Tensor, "N 3"]) -> FreeSpaceSample:
        """Depth and gradient at points; beyond the grid by its nearest vertex."""
        x = x.detach()
        place = ((x / self.radius + 1.0) * (0.5 * (RESOLUTION - 1))).round().long().clamp(0, RESOLUTION - 1)
        camera = self.deepest[place[:, 0], place[:, 1], place[:, 2]]
        away = x - self.cameras[camera]
        distance = away.square().sum(-1).clamp_min(1e-12).sqrt()
        return FreeSpaceSample(self.free[camera] - distance, -away / distance[:, None])

    def _deepest(self, x: Float[Tensor, "P 3"]) -> Tensor:
        return (self.free - torch.cdist(x, self.cameras)).argmax(dim=-1)
