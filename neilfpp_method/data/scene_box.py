"""Where the scene is, for captures that do not say: from points, from silhouettes, or from the cameras.

The scene frame has the object in the unit sphere; a box gives its centre and half of its largest extent
(METHOD's normalisation). What is known best decides: points on the surface, then the masks, whose visual hull
holds the object; the cameras know only what they look at. Points without masks may reach far beyond that, to
walls and trees. A box that holds those holds the cameras as well, or nearly so, and every view could be
explained by fog before its own lens: there the box is about what the cameras look at, and ends well before
them.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float64

from neilfpp_method.data.focus import axes_of, find_focus, meeting_point
from neilfpp_method.data.silhouettes import AGREEMENT, Outline, agreement, read_outlines
from neilfpp_method.data.views import Normalisation, SceneSource, View, check_camera
from neilfpp_method.errors import UserError

__all__ = ["SceneBox", "box_of_cameras", "box_of_focus", "box_of_points", "find_box"]

OUTLIERS = 0.01
"""Share of the points on each side of an axis that the box leaves out."""
MARGIN = 1.1
"""Size of the box over that of its points."""
MIN_POINTS = 20
"""Points from which a box is computed."""
CELLS = 32
REFINEMENTS = 3
REACH = 0.55
"""Radius of the box around what the cameras look at, over their median distance from it. Half of the cameras
are then at least 1.8 scene units away, and one at three quarters of the median is 1.36 away.
"""


@dataclass(frozen=True)
class SceneBox:
    """The scene frame and what told it."""

    normalisation: Normalisation
    source: SceneSource


def find_box(views: Sequence[View], points: Float64[np.ndarray, "P 3"] | None = None) -> SceneBox:
    """The scene box of a capture that has none.

    Args:
        views: the capture's views, with their masks or alpha channels where they have any.
        points: points on the scene's surface, in the world frame; outliers are put up with. Where there are
            masks, only points within them count.

    Raises:
        UserError: a camera is malformed, a mask cannot be read, or nothing tells where the scene is.
    """
    for view in views:
        check_camera(view.camera, str(view.image))
    outlines = read_outlines(views)
    if points is not None and outlines:
        points = points[agreement(outlines, points) >= AGREEMENT]
    if points is not None and len(points) >= MIN_POINTS:
        box = box_of_points(points)
        # Points within masks are the object's own.
        focus = None if outlines else box_of_focus(views)
        return (
            SceneBox(box, "points") if focus is None or box.scale <= focus.scale else SceneBox(focus, "focus")
        )
    if outlines:
        return SceneBox(_carve(outlines, box_of_cameras(views, fill=2.0)), "masks")
    return SceneBox(box_of_cameras(views), "cameras")


def box_of_points(points: Float64[np.ndarray, "P 3"]) -> Normalisation:
    """The box that holds all but the outermost per cent of the points on every side, and a margin.

    Raises:
        UserError: the points lie in one place.
    """
    low, high = np.quantile(points, [OUTLIERS, 1 - OUTLIERS], axis=0)
    return _box(low, high)


def box_of_focus(views: Sequence[View]) -> Normalisation | None:
    """A ball about the place that most cameras look at, which ends at `REACH` of their median distance; none:
    there is no such place (`focus`).
    """
    focus = find_focus(views)
    if focus is None:
        return None
    x, y, z = map(float, focus.centre)
    return Normalisation(REACH * focus.distance, (x, y, z))


def box_of_cameras(views: Sequence[View], fill: float = 1.0) -> Normalisation:
    """A guess: what the cameras look at, as large as the circle that fits into their images, times `fill`.

    The centre is where most cameras look, or else the least-squares point nearest to all optical axes.

    Raises:
        UserError: the axes do not come near one point in front of the cameras.
    """
    where = views[0].image.parent
    axes, focus = axes_of(views), find_focus(views)
    centre = meeting_point(axes, np.ones(len(views))) if focus is None else focus.centre
    if centre is None:
        raise UserError(
            f"{where}: the cameras look in one direction: they do not tell where the scene is",
            "add points or a scene box",
        )
    depth = np.einsum("ni,ni->n", centre - axes.eyes, axes.ahead)
    if np.median(depth) <= 0:
        raise UserError(
            f"{where}: the cameras look away from one another: they do not tell where the scene is",
            "add points or a scene box",
        )
    half = [min(c.width / c.fx, c.height / c.fy) / 2 for c in (view.camera for view in views)]
    radius = float(np.median(depth * half)) * fill
    return Normalisation(radius, (float(centre[0]), float(centre[1]), float(centre[2])))


def _box(low: Float64[np.ndarray, " 3"], high: Float64[np.ndarray, " 3"]) -> Normalisation:
    scale = MARGIN * float((high - low).max()) / 2
    if not scale > 0:
        raise UserError("all points of the scene lie in one place", "add a scene box")
    x, y, z = map(float, (low + high) / 2)
    return Normalisation(scale, (x, y, z))


# ------------------------------------------------------------------------------------------------ silhouettes


def _carve(outlines: Sequence[Outline], start: Normalisation) -> Normalisation:
    """The box of the places that nearly all silhouettes hold, on grids that close in on it."""
    centre, half = np.array(start.centre), np.full(3, start.scale)
    low, high = centre - half, centre + half
    for _ in range(REFINEMENTS):
        axes = [np.linspace(a, b, CELLS) for a, b in zip(low, high, strict=True)]
        cell = (high - low) / (CELLS - 1)
        grid = np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1).reshape(-1, 3)
        held = grid[agreement(outlines, grid) >= AGREEMENT]
        if not len(held):
            raise UserError(
                "the masks have no place in common", "check masks and cameras, or add a scene box"
            )
        low, high = held.min(axis=0) - cell, held.max(axis=0) + cell
    return _box(low, high)
