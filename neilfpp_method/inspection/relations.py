"""Figures that compare views with one another: exposure, duplicates, and where the cameras stand."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np
import torch
from jaxtyping import Bool, Float, Float64

from neilfpp_method.data.capture import Capture
from neilfpp_method.data.views import project

__all__ = ["CameraPlacement", "camera_placement", "duplicates", "exposure_factors"]

NEIGHBOURS = 6
"""Number of views, nearest in pose, with which a view is compared."""
THUMBNAIL = (32, 32)
SAME = 0.02
"""Root mean square difference of standardised thumbnails below which two views are duplicates."""
SEEN_ANGLE = 30.0
"""Largest angle between a covered direction and the nearest view, in degrees."""
SPHERE = 1000
"""Number of directions by which the sphere is sampled."""


@dataclass(frozen=True)
class CameraPlacement:
    """Where the cameras stand about the scene; in the scene frame, whose unit sphere holds the object.

    `away` views do not show the scene's centre, `within` stand in the unit sphere. `coverage` is the share of
    all directions from the centre with a camera at most 30° away, `gap` the median angle, degrees, from one
    camera to the next.
    """

    centres: Float64[np.ndarray, "V 3"]
    axes: Float64[np.ndarray, "V 3"]
    away: Bool[np.ndarray, " V"]
    within: Bool[np.ndarray, " V"]
    coverage: float
    gap: float


def camera_placement(capture: Capture) -> CameraPlacement:
    """Where the cameras of a capture stand."""
    cameras = [capture.normalisation.camera(view.camera) for view in capture.views]
    centres = np.stack([camera.c2w[:, 3] for camera in cameras])
    away = []
    for camera in cameras:
        seen = project(camera, torch.zeros(1, 3, dtype=torch.float64))
        inside = (seen.pixel >= 0) & (seen.pixel < torch.tensor([camera.width, camera.height]))
        away.append(not (bool(inside.all()) and float(seen.depth) > 0))
    distance = np.linalg.norm(centres, axis=1, keepdims=True)
    directions = centres / distance.clip(1e-9)
    cosines = directions @ directions.T
    np.fill_diagonal(cosines, -1.0)
    return CameraPlacement(
        centres=centres,
        axes=np.stack([camera.w2c[2, :3] for camera in cameras]),
        away=np.array(away),
        within=distance[:, 0] < 1.0,
        coverage=float(((_lattice() @ directions.T).max(axis=1) >= np.cos(np.radians(SEEN_ANGLE))).mean()),
        gap=float(np.degrees(np.median(np.arccos(cosines.max(axis=1).clip(-1, 1))))),
    )


def _lattice() -> Float64[np.ndarray, "S 3"]:
    """Directions evenly spread over the sphere (Fibonacci)."""
    k = np.arange(SPHERE) + 0.5
    z, azimuth = 1 - 2 * k / SPHERE, k * np.pi * (3 - np.sqrt(5))
    ring = np.sqrt(1 - z**2)
    return np.stack([ring * np.cos(azimuth), ring * np.sin(azimuth), z], axis=1)


def exposure_factors(luminances: Sequence[float], placement: CameraPlacement) -> Float64[np.ndarray, " V"]:
    """How much brighter each view is than the median of the views nearest in pose; 1 where unknown.

    Near is what stands near and looks the same way: the distance of the centres, in their median distance
    from the scene's, and the angle of the axes count alike.
    """
    light = np.array(luminances)
    scale = max(float(np.median(np.linalg.norm(placement.centres, axis=1))), 1e-9)
    pose = np.concatenate([placement.centres / scale, placement.axes], axis=1)
    lit = light > 0
    factors = np.ones(len(light))
    for i in np.flatnonzero(lit):
        others = np.flatnonzero(lit & (np.arange(len(light)) != i))
        if len(others):
            nearest = others[np.argsort(np.linalg.norm(pose[others] - pose[i], axis=1))[:NEIGHBOURS]]
            factors[i] = light[i] / np.median(light[nearest])
    return factors


def duplicates(pictures: Sequence[Float[np.ndarray, "_ _ 3"]]) -> tuple[tuple[int, int], ...]:
    """Pairs of pictures that are the same but for compression and brightness.

    Their standardised thumbnails differ by under 2 % of their spread. Pictures of one colour are left out.
    """
    thumbnails = np.stack(
        [cv2.resize(np.sqrt(p.mean(axis=-1)), THUMBNAIL, interpolation=cv2.INTER_AREA) for p in pictures]
    )
    flat = thumbnails.reshape(len(pictures), -1)
    spread = flat.std(axis=1)
    flat = (flat - flat.mean(axis=1, keepdims=True)) / np.maximum(spread, 1e-9)[:, None]
    # Of standardised pictures the mean square of the difference is 2 (1 − correlation).
    alike = (flat @ flat.T / flat.shape[1] > 1 - SAME**2 / 2) & (spread > 0)[:, None] & (spread > 0)
    return tuple((int(i), int(j)) for i, j in np.argwhere(np.triu(alike, 1)))
