"""Silhouettes of many views, and which places they hold in common."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Bool, Float64

from neilfpp_method.data.views import View, project

__all__ = ["AGREEMENT", "MOST_VIEWS", "Outline", "agreement"]

AGREEMENT = 0.9
"""A place is held where so many of the views that can tell have it in their silhouette."""
MOST_VIEWS = 32
"""Views that are asked, evenly chosen."""


@dataclass(frozen=True)
class Outline:
    """A view with its silhouette; where that does not touch the border, what lies out of the image is beside it, too."""

    view: View
    inside: Bool[np.ndarray, "H W"]

    @property
    def complete(self) -> bool:
        mask = self.inside
        return not (mask[0].any() or mask[-1].any() or mask[:, 0].any() or mask[:, -1].any())


def agreement(outlines: Sequence[Outline], points: Float64[np.ndarray, "P 3"]) -> Float64[np.ndarray, " P"]:
    """The share of the views that can tell of a point, in whose silhouette it lies; 0 where fewer than half of them can.

    Points are in the frame of the views' cameras.
    """
    told, inside = np.zeros(len(points)), np.zeros(len(points))
    for outline in outlines:
        camera = outline.view.camera
        image = project(camera, torch.from_numpy(points))
        pixel, depth = np.nan_to_num(image.pixel.numpy(), nan=-1.0, posinf=-1.0, neginf=-1.0), image.depth.numpy()
        size = np.array([camera.width, camera.height])
        shown = (depth > 0) & (pixel >= 0).all(axis=1) & (pixel < size).all(axis=1)
        column, row = np.where(shown[:, None], pixel, 0).astype(np.int64).T
        told += shown | outline.complete
        inside += shown & outline.inside[row, column]
    return np.where(told >= len(outlines) / 2, inside / np.maximum(told, 1), 0.0)
