"""Whether a colour that most of the borders share is all that lies behind the scene.

The ground under a sky, or a table that runs out of the picture, leaves half of the border to one colour as
well. What tells them apart is the other views: a thing in the scene has a place that all views see covered, a
sky has none (the visual hull of all that is not of the colour; Laurentini 1994).
"""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np
import torch
from jaxtyping import Float64

from neilfpp_method.data.silhouettes import AGREEMENT, Outline, agreement
from neilfpp_method.data.views import Normalisation
from neilfpp_method.structures import RayBatch

__all__ = ["MAX_RAYS", "leaves_room"]

MAX_RAYS = 1000
"""Rays that are tested."""
PLACES = 65
"""Points on each ray, evenly within the sphere around the scene box."""
RADIUS = math.sqrt(3.0)
"""Of that sphere, scene units: it passes through the corners of the box."""
ROOM = 0.9
"""Share of the rays that must have a point which nothing contradicts."""


def leaves_room(outlines: Sequence[Outline], rays: RayBatch, normalisation: Normalisation) -> bool:
    """Whether what rays see that is not of the backdrop's colour can lie within the scene.

    Args:
        outlines: what is not of that colour in each view; cameras in the world frame.
        rays: through pixels that are not, scene frame.
        normalisation: between the two.
    """
    held = agreement(outlines, _places(rays, normalisation)).reshape(len(rays), PLACES)
    return bool((held >= AGREEMENT).any(axis=1).mean() >= ROOM)


def _places(rays: RayBatch, normalisation: Normalisation) -> Float64[np.ndarray, "P 3"]:
    """Of a ray that passes the sphere by, the place nearest to it."""
    origins, directions = rays.origins.double().cpu(), rays.directions.double().cpu()
    nearest = -(origins * directions).sum(-1, keepdim=True)
    missed = origins.square().sum(-1, keepdim=True) - nearest.square()
    half = (RADIUS**2 - missed).clamp_min(0.0).sqrt()
    along = nearest + half * torch.linspace(-1.0, 1.0, PLACES, dtype=half.dtype)
    points = origins[:, None] + along[..., None] * directions[:, None]
    return normalisation.to_world(points.reshape(-1, 3)).numpy()
