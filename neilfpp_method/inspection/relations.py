"""Compare the views of a capture with one another: exposures, duplicates and camera positions."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np
import torch
from jaxtyping import Bool, Float, Float64

from neilfpp_method.data.cameras.projection import project
from neilfpp_method.data.capture import Capture

__all__ = ["CameraPlacement", "camera_placement", "duplicates", "exposure_factors"]

NEIGHBORS = 6
"""Number of views, nearest in pose, with which a view is compared."""
THUMBNAIL = (32, 32)
"""Width and height of the thumbnails that are compared, in pixels."""
MAX_POSE_DISTANCE = 0.85
"""Distance of two poses beyond which they are not compared: about 35° around the centre. Views farther apart
may show a bright and a dark side of the object.
"""
MAX_DUPLICATE_DIFFERENCE = 0.02
"""Root mean square difference of standardised thumbnails below which two views are duplicates."""
LIT_QUANTILE = 0.99
"""Quantile of the lit pixels of a picture above which brightness is clipped before pictures are compared."""
SEEN_ANGLE = 30.0
"""Largest angle between a covered direction and the nearest view, in degrees."""
SPHERE_DIRECTIONS = 1000
"""Number of sampled directions of the sphere."""


@dataclass(frozen=True)
class CameraPlacement:
    """The placement of V cameras around the scene, in the scene frame.

    Attributes:
        centers: centres of the cameras.
        axes: unit viewing directions.
        away: cameras that do not show the centre of the scene.
        within: cameras inside the unit sphere, which contains the object.
        coverage: share of all directions from the centre that are at most `SEEN_ANGLE` from that of a camera.
        gap: median angle from a camera to the nearest other camera, seen from the centre, in degrees.
    """

    centers: Float64[np.ndarray, "V 3"]
    axes: Float64[np.ndarray, "V 3"]
    away: Bool[np.ndarray, " V"]
    within: Bool[np.ndarray, " V"]
    coverage: float
    gap: float


def camera_placement(capture: Capture) -> CameraPlacement:
    """Compute the placement of the cameras of a capture."""
    cameras = [capture.scene_camera(view) for view in capture.views]
    centers = np.stack([camera.c2w[:, 3] for camera in cameras])
    away = []
    for camera in cameras:
        projected = project(camera, torch.zeros(1, 3, dtype=torch.float64))
        inside = (projected.pixel >= 0) & (projected.pixel < torch.tensor([camera.width, camera.height]))
        away.append(not (bool(inside.all()) and float(projected.depth) > 0))
    distance = np.linalg.norm(centers, axis=1, keepdims=True)
    directions = centers / distance.clip(1e-9)
    cosines = directions @ directions.T
    np.fill_diagonal(cosines, -1.0)
    return CameraPlacement(
        centers=centers,
        axes=np.stack([camera.w2c[2, :3] for camera in cameras]),
        away=np.array(away),
        within=distance[:, 0] < 1.0,
        coverage=float(((_lattice() @ directions.T).max(axis=1) >= np.cos(np.radians(SEEN_ANGLE))).mean()),
        gap=float(np.degrees(np.median(np.arccos(cosines.max(axis=1).clip(-1, 1))))),
    )


def _lattice() -> Float64[np.ndarray, "S 3"]:
    """Evenly distributed directions: the Fibonacci lattice."""
    k = np.arange(SPHERE_DIRECTIONS) + 0.5
    z, azimuth = 1 - 2 * k / SPHERE_DIRECTIONS, k * np.pi * (3 - np.sqrt(5))
    ring = np.sqrt(1 - z**2)
    return np.stack([ring * np.cos(azimuth), ring * np.sin(azimuth), z], axis=1)


def exposure_factors(luminances: Sequence[float], placement: CameraPlacement) -> Float64[np.ndarray, " V"]:
    """Return the brightness of each view relative to the median of the views that are nearest in pose.

    The distance of two poses combines, with equal weights, the distance of the camera centres, divided by
    their median distance from the centre of the scene, and the distance of the unit viewing directions.

    Args:
        luminances: luminance of each view; 0 if it is unknown.
        placement: the cameras of the views.

    Returns:
        A factor per view; 1 if its luminance is unknown, or if no view of known luminance is near.
    """
    light = np.array(luminances)
    scale = max(float(np.median(np.linalg.norm(placement.centers, axis=1))), 1e-9)
    pose = np.concatenate([placement.centers / scale, placement.axes], axis=1)
    nonzero = light > 0
    factors = np.ones(len(light))
    for i in np.flatnonzero(nonzero):
        distance = np.linalg.norm(pose - pose[i], axis=1)
        near = np.flatnonzero(nonzero & (distance < MAX_POSE_DISTANCE) & (np.arange(len(light)) != i))
        if len(near):
            factors[i] = light[i] / np.median(light[near[np.argsort(distance[near])[:NEIGHBORS]]])
    return factors


def _gray(picture: Float[np.ndarray, "h w 3"]) -> Float[np.ndarray, "h w"]:
    """Brightness, clipped at the brightest hundredth of the picture.

    A sun or a broken pixel of HDR images would otherwise determine the correlation of all pictures.
    """
    gray = picture.mean(axis=-1)
    lit = gray[gray > 0]
    return np.minimum(gray, np.quantile(lit, LIT_QUANTILE)) if lit.size else gray


def duplicates(pictures: Sequence[Float[np.ndarray, "_ _ 3"]]) -> tuple[tuple[int, int], ...]:
    """Return the pairs of pictures that are equal except for compression and brightness.

    The standardised thumbnails of such a pair differ by less than 2 % of their standard deviation. Pictures
    of a single colour are ignored.
    """
    thumbnails = np.stack(
        [cv2.resize(np.sqrt(_gray(p)), THUMBNAIL, interpolation=cv2.INTER_AREA) for p in pictures]
    )
    flat = thumbnails.reshape(len(pictures), -1)
    spread = flat.std(axis=1)
    flat = (flat - flat.mean(axis=1, keepdims=True)) / np.maximum(spread, 1e-9)[:, None]
    # The mean squared difference of two standardised pictures is 2 (1 − correlation).
    alike = (
        (flat @ flat.T / flat.shape[1] > 1 - MAX_DUPLICATE_DIFFERENCE**2 / 2)
        & (spread > 0)[:, None]
        & (spread > 0)
    )
    return tuple((int(i), int(j)) for i, j in np.argwhere(np.triu(alike, 1)))
