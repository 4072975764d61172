"""Recognise inverted masks: black on the object and white around it.

Either of two signs is enough:

- Masks cover most of the image borders, but not the point that most cameras look at. This also holds if the
  borders cut the object off.
- Most masks cover the whole border and have a hole, and the holes have a region in common, which is where the
  object is. This also holds if the cameras do not look at the object.

Masks of an object that fills the frame cover the borders as well, but also the point that the cameras look
at. They have no holes, or holes at different places, such as a handle through which the background is seen.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from neilfpp_method.data.focus import find_focus
from neilfpp_method.data.hulls.silhouettes import Outline, sightings
from neilfpp_method.data.hulls.visual_hull import RESOLUTION, visual_hull
from neilfpp_method.data.scene_box import box_of_cameras
from neilfpp_method.errors import UserError

__all__ = ["look_inverted"]

MIN_BORDER_SHARE = 0.5
"""Smallest median share of the border pixels that inverted masks cover."""
MIN_UNCOVERED_SHARE = 0.9
"""Smallest share of the views in which inverted masks do not cover the point that the cameras look at."""
WHOLE_BORDER_SHARE = 0.98
"""Smallest share of the border pixels that counts as the whole border."""
MIN_HOLE_SHARE = 1e-3
"""Smallest share of the image that is a hole; smaller ones are errors of a mask."""


def look_inverted(outlines: Sequence[Outline]) -> bool:
    """Return whether the masks are black on the object and white around it.

    Args:
        outlines: at least one mask, with cameras in the world frame.
    """
    borders = [_border_share(outline) for outline in outlines]
    if float(np.median(borders)) < MIN_BORDER_SHARE:
        return False
    return _spare_the_focus(outlines) or _have_a_common_hole(outlines, borders)


def _border_share(outline: Outline) -> float:
    mask = outline.inside
    return float(np.concatenate([mask[0], mask[-1], mask[1:-1, 0], mask[1:-1, -1]]).mean())


def _spare_the_focus(outlines: Sequence[Outline]) -> bool:
    focus = find_focus([outline.view for outline in outlines])
    if focus is None:
        return False
    counts = sightings(outlines, focus.center[None])
    return bool(counts.inside[0] <= (1 - MIN_UNCOVERED_SHARE) * counts.visible_in[0])


def _have_a_common_hole(outlines: Sequence[Outline], borders: Sequence[float]) -> bool:
    holes = [
        replace(outline, inside=~outline.inside)
        for outline, border in zip(outlines, borders, strict=True)
        if border >= WHOLE_BORDER_SHARE and 1 - outline.inside.mean() >= MIN_HOLE_SHARE
    ]
    if len(holes) <= len(outlines) / 2:
        return False
    try:
        box = box_of_cameras([hole.view for hole in holes], fill=2.0)
    except UserError:
        # The cameras do not show where the scene is, so there is no place to look for a common region.
        return False
    framed = [replace(hole, view=replace(hole.view, camera=box.camera(hole.view.camera))) for hole in holes]
    return bool(visual_hull(framed, 1.0, RESOLUTION).any())
