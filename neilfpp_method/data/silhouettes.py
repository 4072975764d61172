"""Silhouettes of many views, and the points that lie in most of them."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import cv2
import numpy as np
import torch
from jaxtyping import Bool, Float64, Int64

from neilfpp_method.data.camera import scaled_camera
from neilfpp_method.data.images import read_image
from neilfpp_method.data.projection import pixel_index, project
from neilfpp_method.data.views import View

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


def read_outlines(
    views: Sequence[View], max_views: int = MAX_VIEWS, max_side: int = MAX_SIDE
) -> list[Outline]:
    """Read the silhouettes of at most `max_views` evenly chosen views from their masks or alpha channels.

    Masks with more than `max_side` pixels a side are reduced, and a pixel is inside if most of it was. The
    cameras of the returned views have the size of the silhouettes.

    Returns:
        The silhouettes; an empty list if fewer than half of the chosen views have a mask.

    Raises:
        UserError: a mask cannot be read.
    """
    chosen = views[:: -(-len(views) // max_views)]
    outlines = []
    for view in chosen:
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
    """For each of P points, the number of views that see it and the number of silhouettes that contain it."""

    visible_in: Int64[np.ndarray, " P"]
    inside: Int64[np.ndarray, " P"]


def sightings(outlines: Sequence[Outline], points: Float64[np.ndarray, "P 3"]) -> SilhouetteCounts:
    """Count views and silhouettes for points in the frame of the cameras."""
    visible_in, inside = np.zeros(len(points), np.int64), np.zeros(len(points), np.int64)
    for outline in outlines:
        camera = outline.view.camera
        index = pixel_index(project(camera, torch.from_numpy(points)), camera).numpy()
        in_image = index >= 0
        visible_in += in_image | outline.complete
        inside += in_image & outline.inside.ravel()[index]
    return SilhouetteCounts(visible_in, inside)


def agreement(outlines: Sequence[Outline], points: Float64[np.ndarray, "P 3"]) -> Float64[np.ndarray, " P"]:
    """Return the share of the views seeing a point whose silhouette contains it; 0 if fewer than half see it.

    Points are in the frame of the cameras.
    """
    counts = sightings(outlines, points)
    share = counts.inside / np.maximum(counts.visible_in, 1)
    return np.where(counts.visible_in >= len(outlines) / 2, share, 0.0)
