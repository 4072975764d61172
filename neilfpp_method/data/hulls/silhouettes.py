"""Silhouettes of many views, and the points that lie in most of them."""

from __future__ import annotations

from collections.abc import Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from functools import cached_property

import cv2
import numpy as np
import torch
from jaxtyping import Bool, Float32, Float64, Int64

from neilfpp_method.data.cameras.camera import scaled_camera
from neilfpp_method.data.cameras.projection import Projection, pixel_index, project
from neilfpp_method.data.files.images import read_image
from neilfpp_method.data.views import View
from neilfpp_method.errors import UserError

__all__ = [
    "AGREEMENT",
    "MAX_VIEWS",
    "Outline",
    "SilhouetteCounts",
    "agreement",
    "outline_of",
    "read_outlines",
    "sightings",
]

AGREEMENT = 0.9
"""Smallest share of the views that see a point whose silhouettes must contain it."""
MAX_VIEWS = 32
"""Largest number of views, evenly chosen, whose silhouettes are read."""
MAX_SIDE = 512
"""Longer side of a reduced silhouette, in pixels; the scene box needs a precision of hundredths only."""


@dataclass(frozen=True)
class Outline:
    """A view with its silhouette. If it is `complete`, points beyond the image lie outside the silhouette."""

    view: View
    inside: Bool[np.ndarray, "H W"]

    @property
    def complete(self) -> bool:
        mask = self.inside
        return not (mask[0].any() or mask[-1].any() or mask[:, 0].any() or mask[:, -1].any())

    @cached_property
    def distance(self) -> Float32[np.ndarray, "H W"]:
        """Distance of each pixel from the nearest pixel of the silhouette, in pixels; 0 inside."""
        return cv2.distanceTransform(np.uint8(~self.inside), cv2.DIST_L2, cv2.DIST_MASK_PRECISE)


def read_outlines(
    views: Sequence[View], max_views: int = MAX_VIEWS, max_side: int = MAX_SIDE
) -> list[Outline]:
    """Read the silhouettes of at most `max_views` evenly chosen views from their masks or alpha channels.

    Masks with more than `max_side` pixels a side are reduced, and a pixel is inside if most of it was. The
    cameras of the returned views have the size of the silhouettes.

    Returns:
        The silhouettes; an empty list if fewer than half of the chosen views have a mask. Files that cannot
        be read are left out: a training refuses them, and `neilfpp inspect` names them.
    """
    chosen = views[:: -(-len(views) // max_views)]
    outlines = []
    for view in chosen:
        with suppress(UserError):
            image = read_image(view.mask or view.image)
            values = image.alpha if view.mask is None else image.mask
            if values is not None:
                outlines.append(outline_of(view, values > 0.5, max_side))
    return outlines if len(outlines) >= len(chosen) / 2 else []


def outline_of(view: View, mask: Bool[np.ndarray, "H W"], max_side: int = MAX_SIDE) -> Outline:
    """Return the silhouette of a mask, reduced to at most `max_side` pixels a side."""
    factor = max_side / max(mask.shape)
    if factor < 1:
        height, width = (max(1, round(factor * side)) for side in mask.shape)
        mask = cv2.resize(mask.astype(np.float32), (width, height), interpolation=cv2.INTER_AREA) > 0.5
    return Outline(replace(view, camera=scaled_camera(view.camera, *mask.shape[::-1])), mask)


@dataclass(frozen=True)
class SilhouetteCounts:
    """For each of P points or balls, the number of views that see it, and of those whose silhouette contains
    it or, for a ball, a part of it.
    """

    visible_in: Int64[np.ndarray, " P"]
    inside: Int64[np.ndarray, " P"]


def sightings(
    outlines: Sequence[Outline], points: Float64[np.ndarray, "P 3"], reach: float = 0.0
) -> SilhouetteCounts:
    """Count views and silhouettes for points, or for the balls around them.

    A grid of points misses parts that are thinner than its cells. Balls that cover the cells do not: if the
    silhouettes contain a point of a ball, they are counted for the ball.

    Args:
        outlines: the silhouettes.
        points: points in the frame of the cameras.
        reach: radius of the balls, in units of that frame; 0 for the points themselves. A view sees a ball if
            all of it lies in the image, or if the silhouette is `complete`.
    """
    visible_in, inside = np.zeros(len(points), np.int64), np.zeros(len(points), np.int64)
    for outline in outlines:
        camera = outline.view.camera
        projected = project(camera, torch.from_numpy(points))
        if reach > 0:
            visible, contained = _balls(outline, projected, reach)
        else:
            index = pixel_index(projected, camera).numpy()
            visible = (index >= 0) | outline.complete
            contained = (index >= 0) & outline.inside.ravel()[index]
        visible_in += visible
        inside += contained
    return SilhouetteCounts(visible_in, inside)


def _balls(
    outline: Outline, projected: Projection, reach: float
) -> tuple[Bool[np.ndarray, " P"], Bool[np.ndarray, " P"]]:
    """Which balls a view sees, and which of these its silhouette may contain a part of.

    The projection of a ball is bounded by a disc, so a silhouette near a ball may be counted, too.
    """
    camera = outline.view.camera
    size = np.array([camera.width, camera.height])
    depth = projected.depth.numpy()
    pixel = np.nan_to_num(projected.pixel.numpy(), posinf=1e9, neginf=-1e9)
    around_camera = np.abs(depth) <= reach
    radius = max(camera.fx, camera.fy) * reach / np.where(depth > reach, depth - reach, np.inf)
    nearest = np.clip(pixel.astype(np.int64), 0, size - 1)
    beside = np.linalg.norm(pixel - (nearest + 0.5), axis=1)
    # Both are lower bounds of the distance from the silhouette, the second one beside the image.
    gap = np.maximum(outline.distance[nearest[:, 1], nearest[:, 0]] - beside, beside - 1.0)
    touches = around_camera | ((depth > reach) & (gap <= radius))
    in_image = (depth > reach) & ((pixel >= radius[:, None]) & (pixel <= size - radius[:, None])).all(1)
    visible = in_image | outline.complete
    return visible, visible & touches


def agreement(
    outlines: Sequence[Outline], points: Float64[np.ndarray, "P 3"], reach: float = 0.0
) -> Float64[np.ndarray, " P"]:
    """Return the share of the views seeing a point whose silhouette contains it; 0 if fewer than half see it.

    Args:
        outlines: the silhouettes.
        points: points in the frame of the cameras.
        reach: if above 0, balls of this radius are examined in place of the points, see `sightings`.
    """
    counts = sightings(outlines, points, reach)
    share = counts.inside / np.maximum(counts.visible_in, 1)
    return np.where(counts.visible_in >= len(outlines) / 2, share, 0.0)
