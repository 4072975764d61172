"""An oriented point cloud from the points of structure from motion, without outliers."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float64, Int64

from neilfpp_method.data.cameras.colmap_library import pycolmap
from neilfpp_method.data.kd_tree import kd_tree
from neilfpp_method.data.point_cloud import WorldPoints

__all__ = ["SparsePoints", "estimate_normals", "oriented", "reliable", "sparse_points", "without_outliers"]

NEIGHBORS = 12
"""Number of nearest neighbours from which normals and outliers are computed."""

MAX_ERROR = 2.0
"""Largest mean reprojection error of a reliable point, in pixels."""

MIN_TRACK = 3
"""Smallest number of images that must observe a reliable point: the position by two images alone is not
checked by any other observation."""

MAX_DEVIATIONS = 3.0
"""Largest deviation of a point's log mean neighbour distance from the median, in standard deviations."""

MAD_TO_SIGMA = 1.4826
"""Ratio of the standard deviation to the median absolute deviation of a normal distribution."""

MAX_FLATNESS = 0.1
"""Largest ratio of the smallest to the middle eigenvalue of the neighbours' covariance in a flat place."""


@dataclass(frozen=True)
class SparsePoints:
    """Points of structure from motion, in the world frame.

    Attributes:
        position: positions.
        error: mean reprojection error of each point, in pixels.
        track: number of images that observe each point.
        towards: unit mean of the directions from each point to the cameras that observe it; 0 if none does.
    """

    position: Float64[np.ndarray, "P 3"]
    error: Float64[np.ndarray, " P"]
    track: Int64[np.ndarray, " P"]
    towards: Float64[np.ndarray, "P 3"]

    def __len__(self) -> int:
        return len(self.position)

    def __getitem__(self, rows: Bool[np.ndarray, " P"]) -> SparsePoints:
        return SparsePoints(self.position[rows], self.error[rows], self.track[rows], self.towards[rows])


def sparse_points(model: pycolmap.Reconstruction) -> SparsePoints:
    """Return all points of a COLMAP model."""
    centers = {i: model.image(i).projection_center() for i in model.reg_image_ids()}
    points = list(model.points3D.values())
    position = np.array([point.xyz for point in points], dtype=np.float64).reshape(-1, 3)
    towards = np.zeros_like(position)
    for i, point in enumerate(points):
        for element in point.track.elements:
            direction = centers[element.image_id] - point.xyz
            towards[i] += direction / np.linalg.norm(direction)
    return SparsePoints(
        position=position,
        error=np.array([point.error for point in points], dtype=np.float64),
        track=np.array([point.track.length() for point in points], dtype=np.int64),
        towards=towards / np.maximum(np.linalg.norm(towards, axis=1, keepdims=True), 1e-12),
    )


def reliable(points: SparsePoints) -> Bool[np.ndarray, " P"]:
    """Return which points have 3 observations or more, errors of at most 2 pixels, and are not isolated."""
    good = (
        (points.error <= MAX_ERROR) & (points.track >= MIN_TRACK) & np.isfinite(points.position).all(axis=1)
    )
    good[good] = _not_isolated(points.position[good])
    return good


def oriented(points: SparsePoints) -> WorldPoints:
    """Return the reliable points whose neighbours lie close to a plane, with the normal of that plane."""
    points = points[reliable(points)]
    if len(points) <= NEIGHBORS:
        return WorldPoints(np.empty((0, 3)), np.empty((0, 3)))
    estimated = estimate_normals(points.position, points.towards)
    return WorldPoints(points.position[estimated.flat], estimated.normal[estimated.flat])


def without_outliers(points: WorldPoints) -> WorldPoints:
    """Return the points of a cloud that are not isolated, for example those of multi-view stereo."""
    good = _not_isolated(points.position)
    return WorldPoints(points.position[good], points.normal[good])


@dataclass(frozen=True)
class EstimatedNormals:
    """Unit normals of P points, and whether the neighbours of each point are flat.

    They are flat if their smallest variance is at most a tenth (`MAX_FLATNESS`) of the next larger one.
    """

    normal: Float64[np.ndarray, "P 3"]
    flat: Bool[np.ndarray, " P"]


def estimate_normals(
    position: Float64[np.ndarray, "P 3"], towards: Float64[np.ndarray, "P 3"]
) -> EstimatedNormals:
    """Estimate normals by principal component analysis of the nearest neighbours.

    The normal is the direction of the smallest variance of the neighbours.

    Args:
        position: at least `NEIGHBORS` + 1 points.
        towards: for each point a direction; its normal has a non-negative dot product with it.
    """
    neighbors = kd_tree(position).query(position, k=NEIGHBORS + 1)[1]
    spread = position[neighbors] - position[neighbors].mean(axis=1, keepdims=True)
    values, vectors = np.linalg.eigh(np.einsum("pki,pkj->pij", spread, spread))
    normal = vectors[:, :, 0]
    normal = normal * np.where((normal * towards).sum(axis=1, keepdims=True) < 0, -1.0, 1.0)
    return EstimatedNormals(normal, values[:, 0] <= MAX_FLATNESS * values[:, 1])


def _not_isolated(position: Float64[np.ndarray, "P 3"]) -> Bool[np.ndarray, " P"]:
    """Which points have a mean neighbour distance that is not unusually large.

    The logarithm of the distance is compared with its median over all points, in standard deviations
    estimated from the median absolute deviation, which outliers do not influence.
    """
    if len(position) <= NEIGHBORS:
        return np.ones(len(position), dtype=bool)
    distances = kd_tree(position).query(position, k=NEIGHBORS + 1)[0][:, 1:]
    log_distance = np.log(np.maximum(distances.mean(axis=1), 1e-12))
    median = np.median(log_distance)
    deviation = MAD_TO_SIGMA * np.median(np.abs(log_distance - median))
    return log_distance <= median + MAX_DEVIATIONS * max(deviation, 1e-3)
