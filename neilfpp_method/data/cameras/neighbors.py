"""Which cameras see a scene from nearby, so that their images can be compared."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from jaxtyping import Float64

from neilfpp_method.data.cameras.camera import Camera

__all__ = ["choose_sources"]

BEST_ANGLE = 12.0
"""Preferred angle between the directions in which two cameras see the scene's centre, in degrees: wide enough
to measure depth, narrow enough that both images look alike."""

MIN_ANGLE = 3.0
"""Smallest angle between two cameras, in degrees. Below it, a pixel of disparity is a large step in depth."""

MAX_ANGLE = 35.0
"""Largest angle between two cameras, in degrees. Above it, perspective and occlusion change the images too
much for a correlation of windows."""


def choose_sources(
    cameras: Sequence[Camera], center: Float64[np.ndarray, " 3"], count: int
) -> list[list[int]]:
    """Choose the source views of each view by the angle between the two cameras as seen from `center`.

    Args:
        cameras: the cameras of all views, in the world frame.
        center: centre of the scene, in the world frame.
        count: largest number of sources per view.

    Returns:
        For each camera the indices of its sources, best first: the angles between `MIN_ANGLE` and `MAX_ANGLE`
        whose ratio to `BEST_ANGLE` is closest to 1. The list of a camera may be empty.
    """
    eyes = np.stack([camera.c2w[:, 3] for camera in cameras])
    directions = (eyes - center) / np.linalg.norm(eyes - center, axis=1, keepdims=True)
    angles = np.degrees(np.arccos(np.clip(directions @ directions.T, -1.0, 1.0)))
    cost = np.abs(np.log(np.maximum(angles, 1e-3) / BEST_ANGLE))
    cost[(angles < MIN_ANGLE) | (angles > MAX_ANGLE)] = np.inf
    order = np.argsort(cost, axis=1)[:, :count]
    return [[int(j) for j in row if np.isfinite(cost[i, j])] for i, row in enumerate(order)]
