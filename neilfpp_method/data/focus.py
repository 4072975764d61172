"""The point that most cameras look at: the point closest to their optical axes.

A photographer walks around the object and aims at it, so the axes locate it even if the points do not:
structure from motion finds points on walls and trees as well.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float64

from neilfpp_method.data.views import View

__all__ = ["Axes", "Focus", "axes_of", "find_focus", "meeting_point"]

ITERATIONS = 50
"""Iterations of reweighted least squares, which converges in about twenty."""
MIN_DISTANCE = 1e-3
"""Smallest distance of an axis, as a share of the median camera distance; it bounds the weights."""
CENTRAL_SHARE = 0.5
"""Central part of the image, along both sides, in which a point counts as looked at."""
MIN_SHARE = 2 / 3
"""Smallest share of the cameras that must look at the point."""
MIN_SPREAD_DEG = 10.0
"""Least root mean square angle of the axes from their common plane or line. Cameras are aimed to a few
degrees, so the intersection of axes closer to parallel is random.
"""


@dataclass(frozen=True)
class Axes:
    """Optical axes: camera centres and unit viewing directions, in the world frame."""

    eyes: Float64[np.ndarray, "V 3"]
    ahead: Float64[np.ndarray, "V 3"]

    @property
    def across(self) -> Float64[np.ndarray, "V 3 3"]:
        """I − a aᵀ for each axis a: the projection onto the plane perpendicular to it."""
        return np.eye(3) - self.ahead[:, :, None] * self.ahead[:, None, :]


@dataclass(frozen=True)
class Focus:
    """A point in the world frame, the cameras that look at it, and their median distance from it."""

    center: Float64[np.ndarray, " 3"]
    looking: Bool[np.ndarray, " V"]
    distance: float


def axes_of(views: Sequence[View]) -> Axes:
    """Return the optical axes of views."""
    poses = np.stack([view.camera.c2w for view in views])
    return Axes(poses[:, :, 3], poses[:, :, 2])


def find_focus(views: Sequence[View]) -> Focus | None:
    """Find the point that most cameras look at.

    The point minimises the sum of its distances to all axes. Squared distances are not used, because a few
    cameras that look elsewhere would shift the minimum.

    Returns:
        The point; None if fewer than two thirds of the cameras have it in the central part of their image, or
        if their axes are so close to parallel that its depth is undetermined.

    Example:
        >>> focus = find_focus(capture.views)
        >>> focus and focus.center, focus and focus.distance
    """
    axes = axes_of(views)
    weights = np.ones(len(views))
    for _ in range(ITERATIONS):
        center = meeting_point(axes, weights)
        if center is None:
            return None
        to = center - axes.eyes
        beside = np.linalg.norm(np.einsum("vij,vj->vi", axes.across, to), axis=1)
        weights = 1.0 / np.maximum(beside, MIN_DISTANCE * np.median(np.linalg.norm(to, axis=1)) + 1e-12)
    looking = np.array([_looks_at(view, center) for view in views])
    if looking.mean() < MIN_SHARE:
        return None
    spread = np.linalg.eigvalsh(axes.across[looking].mean(axis=0))[0]
    if spread < np.sin(np.radians(MIN_SPREAD_DEG)) ** 2:
        return None
    return Focus(center, looking, float(np.median(np.linalg.norm(to[looking], axis=1))))


def meeting_point(axes: Axes, weights: Float64[np.ndarray, " V"]) -> Float64[np.ndarray, " 3"] | None:
    """Return the weighted least-squares point of the axes; None if all axes are parallel."""
    system = np.einsum("v,vij->ij", weights / weights.sum(), axes.across)
    if np.linalg.eigvalsh(system)[0] < 1e-4:
        return None
    return np.linalg.solve(system, np.einsum("v,vij,vj->i", weights / weights.sum(), axes.across, axes.eyes))


def _looks_at(view: View, place: Float64[np.ndarray, " 3"]) -> bool:
    """Whether a point lies in the central part of a view, where lens distortion is negligible."""
    camera = view.camera
    x, y, depth = camera.w2c[:3, :3] @ place + camera.w2c[:3, 3]
    if depth <= 0:
        return False
    column, row = camera.fx * x / depth + camera.cx, camera.fy * y / depth + camera.cy
    across, down = abs(column / camera.width - 0.5), abs(row / camera.height - 0.5)
    return bool(max(across, down) <= CENTRAL_SHARE / 2)
