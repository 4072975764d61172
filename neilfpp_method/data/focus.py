"""The place that most cameras look at: where their optical axes come nearest to one another.

People who photograph a thing aim at it, and walk about it. So the axes tell where it is even where points do
not: structure from motion finds points on walls and trees as well.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float64

from neilfpp_method.data.views import View

__all__ = ["Axes", "Focus", "axes_of", "find_focus", "meeting_point"]

ITERATIONS = 50
"""Rounds of reweighted least squares; it converges in about twenty."""
MIN_DISTANCE = 1e-3
"""Share of the median distance below which an axis passes through the centre: it bounds the weights."""
CENTRAL_SHARE = 0.5
"""Central part of a picture, along both sides, that counts as what its camera looks at."""
MIN_SHARE = 2 / 3
"""Share of the cameras that must look at the place."""
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
        """I − a aᵀ for each: what it leaves of a vector is the part that is perpendicular to the axis."""
        return np.eye(3) - self.ahead[:, :, None] * self.ahead[:, None, :]


@dataclass(frozen=True)
class Focus:
    """A place, in the world frame, which cameras look at it, and the median distance from which these do."""

    centre: Float64[np.ndarray, " 3"]
    looking: Bool[np.ndarray, " V"]
    distance: float


def axes_of(views: Sequence[View]) -> Axes:
    """The optical axes of views."""
    poses = np.stack([view.camera.c2w for view in views])
    return Axes(poses[:, :, 3], poses[:, :, 2])


def find_focus(views: Sequence[View]) -> Focus | None:
    """The place that most cameras look at, or none.

    The sum of the distances to all axes is least there, and not that of their squares: a few cameras that
    look elsewhere do not move it. None where fewer than two thirds of the cameras have it in the middle of
    their picture, or where their axes are so nearly parallel that it could be at any depth.

    Example:
        >>> focus = find_focus(capture.views)
        >>> focus and focus.centre, focus and focus.distance
    """
    axes = axes_of(views)
    weights = np.ones(len(views))
    for _ in range(ITERATIONS):
        centre = meeting_point(axes, weights)
        if centre is None:
            return None
        to = centre - axes.eyes
        beside = np.linalg.norm(np.einsum("vij,vj->vi", axes.across, to), axis=1)
        weights = 1.0 / np.maximum(beside, MIN_DISTANCE * np.median(np.linalg.norm(to, axis=1)) + 1e-12)
    looking = np.array([_looks_at(view, centre) for view in views])
    if looking.mean() < MIN_SHARE:
        return None
    spread = np.linalg.eigvalsh(axes.across[looking].mean(axis=0))[0]
    if spread < np.sin(np.radians(MIN_SPREAD_DEG)) ** 2:
        return None
    return Focus(centre, looking, float(np.median(np.linalg.norm(to[looking], axis=1))))


def meeting_point(axes: Axes, weights: Float64[np.ndarray, " V"]) -> Float64[np.ndarray, " 3"] | None:
    """The point with the least weighted sum of squared distances to the axes; none where all are parallel."""
    system = np.einsum("v,vij->ij", weights / weights.sum(), axes.across)
    if np.linalg.eigvalsh(system)[0] < 1e-4:
        return None
    return np.linalg.solve(system, np.einsum("v,vij,vj->i", weights / weights.sum(), axes.across, axes.eyes))


def _looks_at(view: View, place: Float64[np.ndarray, " 3"]) -> bool:
    """Whether a place lies in the middle of a view's picture; a lens bends nothing there."""
    camera = view.camera
    x, y, depth = camera.w2c[:3, :3] @ place + camera.w2c[:3, 3]
    if depth <= 0:
        return False
    column, row = camera.fx * x / depth + camera.cx, camera.fy * y / depth + camera.cy
    across, down = abs(column / camera.width - 0.5), abs(row / camera.height - 0.5)
    return bool(max(across, down) <= CENTRAL_SHARE / 2)
