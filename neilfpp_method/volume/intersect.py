"""Intersection of rays with the scene sphere."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from jaxtyping import Float
from torch import Tensor

__all__ = ["Interval", "sphere_interval"]


@dataclass(frozen=True)
class Interval:
    """A part of each ray, as distances from its origin in scene units: 0 ≤ near ≤ far."""

    near: Float[Tensor, " N"]
    far: Float[Tensor, " N"]


@torch.no_grad()
def sphere_interval(
    origins: Float[Tensor, "N 3"], directions: Float[Tensor, "N 3"], radius: float
) -> Interval:
    """The part of each ray inside the sphere of `radius` around the origin of the scene frame.

    near = max(m − h, 0) and far = max(m + h, 0), with m = −o·d the distance of closest approach and h² =
    max(radius² − ‖o + m d‖², 0). A ray that starts inside has near = 0. A ray that misses the sphere has near
    = far. No gradient flows through the ends.

    Args:
        origins: ray origins, scene frame.
        directions: unit vectors.
        radius: radius of the sphere, scene units.
    """
    closest = -(origins * directions).sum(dim=-1)
    # Not ‖o‖² − m²: for distant cameras this difference of large squares loses digits.
    perpendicular = origins + closest[:, None] * directions
    half = (radius**2 - perpendicular.square().sum(dim=-1)).clamp_min(0.0).sqrt()
    return Interval((closest - half).clamp_min(0.0), (closest + half).clamp_min(0.0))
