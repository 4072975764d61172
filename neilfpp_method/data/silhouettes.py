"""Silhouettes of many views, and which places they hold in common."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import cv2
import numpy as np
import torch
from jaxtyping import Bool, Float64, Int64

from neilfpp_method.data.images import read_image
from neilfpp_method.data.views import Camera, View, project

__all__ = ["AGREEMENT", "MAX_VIEWS", "Outline", "Sightings", "agreement", "read_outlines", "sightings"]

AGREEMENT = 0.9
"""Share of the views that see a place which must have it in their silhouette."""
MAX_VIEWS = 32
"""Evenly chosen views whose silhouettes are read."""
MAX_SIDE = 512
"""Pixels along the longer side of a silhouette: places are resolved to hundredths of the scene only."""


@dataclass(frozen=True)
class Outline:
    """A view with its silhouette; where that misses the border, places beyond the image are outside it."""

    view: View
    inside: Bool[np.ndarray, "H W"]

    @property
    def complete(self) -> bool:
        mask = self.inside
        return not (mask[0].any() or mask[-1].any() or mask[:, 0].any() or mask[:, -1].any())


def read_outlines(views: Sequence[View], most: int = MAX_VIEWS, longest: int = MAX_SIDE) -> list[Outline]:
    """The silhouettes, by mask or alpha, of at most `most` evenly chosen views, with matching cameras.

    None where fewer than half of these have one. An alpha channel that is opaque all over is none. The masks
    are read one after the other, and those with more than `longest` pixels along a side are made smaller: a
    pixel is then inside where most of it was.

    Raises:
        UserError: a mask cannot be read.
    """
    chosen = views[:: -(-len(views) // most)]
    outlines = []
    for view in chosen:
        image = read_image(view.mask or view.image)
        values = image.alpha if view.mask is None else image.mask
        if values is not None:
            outlines.append(_outline(view, values > 0.5, longest))
    return outlines if len(outlines) >= len(chosen) / 2 else []


def _outline(view: View, mask: Bool[np.ndarray, "H W"], longest: int) -> Outline:
    factor = longest / max(mask.shape)
    if factor < 1:
        height, width = (max(1, round(factor * side)) for side in mask.shape)
        mask = cv2.resize(mask.astype(np.float32), (width, height), interpolation=cv2.INTER_AREA) > 0.5
    return Outline(replace(view, camera=_of_size(view.camera, *mask.shape)), mask)


def _of_size(camera: Camera, height: int, width: int) -> Camera:
    """The camera with the same field of view and another number of pixels."""
    across, down = width / camera.width, height / camera.height
    focal = {"fx": across * camera.fx, "fy": down * camera.fy}
    return replace(camera, **focal, cx=across * camera.cx, cy=down * camera.cy, width=width, height=height)


@dataclass(frozen=True)
class Sightings:
    """Of each of P places: how many views can tell of it, and in how many of their silhouettes it lies."""

    seen: Int64[np.ndarray, " P"]
    inside: Int64[np.ndarray, " P"]


def sightings(outlines: Sequence[Outline], points: Float64[np.ndarray, "P 3"]) -> Sightings:
    """What the views tell of points, which are in the frame of the views' cameras."""
    seen, inside = np.zeros(len(points), np.int64), np.zeros(len(points), np.int64)
    for outline in outlines:
        camera = outline.view.camera
        image = project(camera, torch.from_numpy(points))
        pixel, depth = (
            np.nan_to_num(image.pixel.numpy(), nan=-1.0, posinf=-1.0, neginf=-1.0),
            image.depth.numpy(),
        )
        size = np.array([camera.width, camera.height])
        shown = (depth > 0) & (pixel >= 0).all(axis=1) & (pixel < size).all(axis=1)
        column, row = np.where(shown[:, None], pixel, 0).astype(np.int64).T
        seen += shown | outline.complete
        inside += shown & outline.inside[row, column]
    return Sightings(seen, inside)


def agreement(outlines: Sequence[Outline], points: Float64[np.ndarray, "P 3"]) -> Float64[np.ndarray, " P"]:
    """Share of the views that see a point with it in their silhouette; 0 where under half of them see it.

    Points are in the frame of the views' cameras.
    """
    found = sightings(outlines, points)
    return np.where(found.seen >= len(outlines) / 2, found.inside / np.maximum(found.seen, 1), 0.0)
