"""Points of structure from motion as an oriented cloud: outliers removed, normals towards cameras."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float64, Int64
from scipy.spatial import cKDTree

from neilfpp_method.data.colmap_library import pycolmap
from neilfpp_method.data.point_cloud import WorldPoints

__all__ = ["SparsePoints", "estimate_normals", "oriented", "reliable", "sparse_points", "without_outliers"]

NEIGHBOURS = 12
MAX_ERROR = 2.0
MIN_TRACK = 3
FAR = 3.0
FLAT = 0.1


@dataclass(frozen=True)
class SparsePoints:
    """Points with what is known of each: its reprojection error in pixels, in how many images it is, and the
    unit mean of the directions to the cameras that see it.
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
    """All points of a model. Those that no image sees, as models of known points have, look nowhere."""
    centres = {i: model.image(i).projection_center() for i in model.reg_image_ids()}
    points = list(model.points3D.values())
    position = np.array([point.xyz for point in points], dtype=np.float64).reshape(-1, 3)
    towards = np.zeros_like(position)
    for i, point in enumerate(points):
        for element in point.track.elements:
            direction = centres[element.image_id] - point.xyz
            towards[i] += direction / np.linalg.norm(direction)
    return SparsePoints(
        position=position,
        error=np.array([point.error for point in points], dtype=np.float64),
        track=np.array([point.track.length() for point in points], dtype=np.int64),
        towards=towards / np.maximum(np.linalg.norm(towards, axis=1, keepdims=True), 1e-12),
    )


def reliable(points: SparsePoints) -> Bool[np.ndarray, " P"]:
    """Which points to trust: seen in at least 3 images, with errors of at most 2 pixels, not alone."""
    good = (
        (points.error <= MAX_ERROR) & (points.track >= MIN_TRACK) & np.isfinite(points.position).all(axis=1)
    )
    good[good] = _in_company(points.position[good])
    return good


def oriented(points: SparsePoints) -> WorldPoints:
    """The reliable points whose surroundings are flat enough to tell a normal, with it."""
    points = points[reliable(points)]
    if len(points) <= NEIGHBOURS:
        return WorldPoints(np.empty((0, 3)), np.empty((0, 3)))
    normal, flat = estimate_normals(points.position, points.towards)
    return WorldPoints(points.position[flat], normal[flat])


def without_outliers(points: WorldPoints) -> WorldPoints:
    """The points of a cloud, such as one of multi-view stereo, that are not alone."""
    good = _in_company(points.position)
    return WorldPoints(points.position[good], points.normal[good])


def estimate_normals(
    position: Float64[np.ndarray, "P 3"], towards: Float64[np.ndarray, "P 3"]
) -> tuple[Float64[np.ndarray, "P 3"], Bool[np.ndarray, " P"]]:
    """Unit normals on the side of `towards`, and where the neighbours are flat enough to mean one.

    The normal is the direction in which the nearest neighbours spread least; the surroundings are flat where
    that spread, a variance, is at most a tenth of the next larger one.
    """
    neighbours = cKDTree(position).query(position, k=NEIGHBOURS + 1)[1]
    spread = position[neighbours] - position[neighbours].mean(axis=1, keepdims=True)
    values, vectors = np.linalg.eigh(np.einsum("pki,pkj->pij", spread, spread))
    normal = vectors[:, :, 0]
    normal = normal * np.where((normal * towards).sum(axis=1, keepdims=True) < 0, -1.0, 1.0)
    return normal, values[:, 0] <= FLAT * values[:, 1]


def _in_company(position: Float64[np.ndarray, "P 3"]) -> Bool[np.ndarray, " P"]:
    """Which points have a mean neighbour distance within 3 deviations of its logarithm over all points.

    The median and the median deviation tell what is common, so that outliers have no say in it.
    """
    if len(position) <= NEIGHBOURS:
        return np.ones(len(position), dtype=bool)
    distance = np.log(
        np.maximum(cKDTree(position).query(position, k=NEIGHBOURS + 1)[0][:, 1:].mean(axis=1), 1e-12)
    )
    middle = np.median(distance)
    deviation = 1.4826 * np.median(np.abs(distance - middle))
    return distance <= middle + FAR * max(deviation, 1e-3)
