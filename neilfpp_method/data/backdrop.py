"""Test whether the colour that most image borders share is the background behind the scene.

If the images show the ground under a sky, or a table that extends beyond the images, half of the border has
one colour as well. The views together distinguish these cases: everything that is not background must lie
inside the scene, in the visual hull (Laurentini 1994) of all pixels that do not have the background colour.
"""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np
import torch
from jaxtyping import Float64

from neilfpp_method.data.silhouettes import AGREEMENT, Outline, agreement
from neilfpp_method.data.views import Normalization
from neilfpp_method.structures import RayBatch

__all__ = ["MAX_RAYS", "leaves_room"]

MAX_RAYS = 1000
"""Largest number of rays that are tested."""
PLACES = 65
"""Number of test points on each ray, evenly spaced inside the sphere around the scene box."""
RADIUS = math.sqrt(3.0)
"""Radius of that sphere, scene units: it passes through the corners of the box."""
MIN_INSIDE_SHARE = 0.9
"""Share of the rays that must have a test point inside the visual hull."""


def leaves_room(outlines: Sequence[Outline], rays: RayBatch, normalization: Normalization) -> bool:
    """Return whether the pixels that do not have the background colour can lie within the scene.

    Args:
        outlines: for each view, the pixels without that colour; cameras in the world frame.
        rays: rays through such pixels, in the scene frame.
        normalization: the transformation between the two frames.
    """
    held = agreement(outlines, _places(rays, normalization)).reshape(len(rays), PLACES)
    return bool((held >= AGREEMENT).any(axis=1).mean() >= MIN_INSIDE_SHARE)


def _places(rays: RayBatch, normalization: Normalization) -> Float64[np.ndarray, "P 3"]:
    """Test points on each ray, world frame; the closest point of a ray that misses the sphere."""
    origins, directions = rays.origins.double().cpu(), rays.directions.double().cpu()
    nearest = -(origins * directions).sum(-1, keepdim=True)
    missed = origins.square().sum(-1, keepdim=True) - nearest.square()
    half = (RADIUS**2 - missed).clamp_min(0.0).sqrt()
    along = nearest + half * torch.linspace(-1.0, 1.0, PLACES, dtype=half.dtype)
    points = origins[:, None] + along[..., None] * directions[:, None]
    return normalization.to_world(points.reshape(-1, 3)).numpy()
