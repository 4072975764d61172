"""Find the scene box of a capture that does not state it: from points, from silhouettes, or from the cameras.

The scene frame has the object in the unit sphere; the box gives its centre and half of its largest extent.
The most reliable source is used: points on the surface, then the masks, whose visual hull contains the
object, then the cameras. Points without masks may extend far beyond the object, to walls and trees. A box
around all of them would contain the cameras as well, and every view could then be explained by density close
to its own camera. In this case, or if the points extend far to one side, the box is placed around the point
that the cameras look at, and ends well before them.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float64

from neilfpp_method.data.cameras.camera import POSE_MISTAKES, check_camera
from neilfpp_method.data.focus import axes_of, find_focus, meeting_point
from neilfpp_method.data.hulls.silhouettes import AGREEMENT, Outline, agreement, read_outlines
from neilfpp_method.data.views import Normalization, SceneSource, View
from neilfpp_method.errors import UserError

__all__ = ["SceneBox", "box_of_cameras", "box_of_focus", "box_of_points", "find_box"]

OUTLIER_SHARE = 0.01
"""Share of the points that the box leaves out at either end of each axis."""
MARGIN = 1.1
"""Ratio of the size of the box to the extent of its points."""
MIN_POINTS = 20
"""Smallest number of points from which a box is computed."""
CELLS = 48
"""Grid points along each axis of the visual hull."""

REFINEMENTS = 3
"""Number of grids, each of which covers the hull that the previous one found."""

SAME_PLACE = 1e-10
"""Extent of the camera centres, relative to their largest coordinate, below which they are one point that was
computed with rounding errors."""

OFF_CENTER = 0.5
"""Distance of the middle of a box of points from the focus of the cameras, relative to the scale of the box,
above which the box is discarded: a few points far behind the object have moved it to one side."""

FOCUS_BOX_RADIUS = 0.55
"""Ratio of the radius of a box around the focus of the cameras to their median distance from it. Half of the
cameras are then at least 1.8 scene units away, and a camera at three quarters of the median distance is 1.36
away."""


@dataclass(frozen=True)
class SceneBox:
    """The normalisation to the scene frame, and its source."""

    normalization: Normalization
    source: SceneSource


def find_box(views: Sequence[View], points: Float64[np.ndarray, "P 3"] | None = None) -> SceneBox:
    """Find the scene box of a capture that does not state it.

    Args:
        views: the views of the capture, with masks or alpha channels if they have any.
        points: points on the surface of the scene, in the world frame; outliers are tolerated. If there are
            masks, only points inside them are used.

    Raises:
        UserError: a camera is malformed, or the extent of the scene cannot be determined.
    """
    for view in views:
        check_camera(view.camera, str(view.image))
    # A mask of nothing, which a training refuses and `neilfpp inspect` names, says nothing about the box.
    outlines = [outline for outline in read_outlines(views) if outline.inside.any()]
    if points is not None and outlines:
        points = points[agreement(outlines, points) >= AGREEMENT]
    if points is not None and len(points) >= MIN_POINTS:
        box = box_of_points(points)
        # Points inside the masks belong to the object, so their box is not too large.
        focus = None if outlines else box_of_focus(views)
        if focus is None or (box.scale <= focus.scale and _is_central(box, focus)):
            return SceneBox(box, "points")
        return SceneBox(focus, "focus")
    if outlines:
        return SceneBox(_carve(outlines, box_of_cameras(views, fill=2.0)), "masks")
    return SceneBox(box_of_cameras(views), "cameras")


def _is_central(box: Normalization, focus: Normalization) -> bool:
    """Whether the cameras look at the middle of the box, at most `OFF_CENTER` of its scale away."""
    return math.dist(box.center, focus.center) <= OFF_CENTER * box.scale


def box_of_points(points: Float64[np.ndarray, "P 3"]) -> Normalization:
    """Return the box of all points but 1 % at either end of each axis, with a margin.

    Raises:
        UserError: all points are equal.
    """
    low, high = np.quantile(points, [OUTLIER_SHARE, 1 - OUTLIER_SHARE], axis=0)
    return _box(low, high)


def box_of_focus(views: Sequence[View]) -> Normalization | None:
    """Return a ball around the point that most cameras look at, with a radius of `FOCUS_BOX_RADIUS` times
    their median distance from it.

    Returns None if there is no such point (`find_focus`).
    """
    focus = find_focus(views)
    if focus is None:
        return None
    x, y, z = map(float, focus.center)
    return Normalization(FOCUS_BOX_RADIUS * focus.distance, (x, y, z))


def box_of_cameras(views: Sequence[View], fill: float = 1.0) -> Normalization:
    """Guess the box from the cameras: `fill` times the largest circle that fits into their images.

    The centre is the point that most cameras look at, or else the least-squares point of all optical axes.

    Raises:
        UserError: the axes are parallel, most cameras do not show the point where they meet, or the cameras
            are at one point.
    """
    where = views[0].image.parent
    axes, focus = axes_of(views), find_focus(views)
    center = meeting_point(axes, np.ones(len(views))) if focus is None else focus.center
    if center is None:
        raise UserError(
            f"{where}: the cameras look in one direction, so the position of the scene is unknown",
            "add points or a scene box",
        )
    spread = np.ptp(axes.eyes, axis=0).max()
    if spread <= SAME_PLACE * np.abs(axes.eyes).max():
        raise UserError(
            f"{where}: all cameras are at one point, so the position of the scene is unknown",
            "take photographs from several sides, or add a scene box",
        )
    depth = np.einsum("ni,ni->n", center - axes.eyes, axes.ahead)
    beside = np.linalg.norm(np.einsum("nij,nj->ni", axes.across, center - axes.eyes), axis=1)
    half = np.array([min(c.width / c.fx, c.height / c.fy) / 2 for c in (view.camera for view in views)])
    if (beside < half * depth).mean() <= 0.5:
        raise UserError(
            f"{where}: the cameras look away from one another, as on a tripod that turns, so the position of "
            "the scene is unknown",
            "take photographs from several sides of the object, or add points or a scene box; if they are "
            f"from several sides, {POSE_MISTAKES}",
        )
    radius = float(np.median(depth * half)) * fill
    return Normalization(radius, (float(center[0]), float(center[1]), float(center[2])))


def _box(low: Float64[np.ndarray, " 3"], high: Float64[np.ndarray, " 3"]) -> Normalization:
    scale = MARGIN * float((high - low).max()) / 2
    if not scale > 0:
        raise UserError("all points of the scene are equal", "add a scene box")
    x, y, z = map(float, (low + high) / 2)
    return Normalization(scale, (x, y, z))


# ------------------------------------------------------------------------------------------------ silhouettes


def _carve(outlines: Sequence[Outline], start: Normalization) -> Normalization:
    """The box of the visual hull, from successively finer grids.

    A cell is kept if nearly all silhouettes contain a part of it. Its centre alone would miss thin parts: the
    legs of a chair, and with them half of its height.
    """
    center, half = np.array(start.center), np.full(3, start.scale)
    low, high = center - half, center + half
    for _ in range(REFINEMENTS):
        axes = [np.linspace(a, b, CELLS) for a, b in zip(low, high, strict=True)]
        cell = (high - low) / (CELLS - 1)
        grid = np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1).reshape(-1, 3)
        held = grid[agreement(outlines, grid, reach=float(np.linalg.norm(cell)) / 2) >= AGREEMENT]
        if not len(held):
            raise UserError(
                "no point of the scene lies in all masks",
                "check the cameras and the masks, which are white on the object, or add a scene box",
            )
        low, high = held.min(axis=0) - cell, held.max(axis=0) + cell
    return _box(held.min(axis=0), held.max(axis=0))
