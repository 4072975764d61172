"""Simplify a surface within a given distance."""

from __future__ import annotations

from dataclasses import dataclass

import fast_simplification
import numpy as np
import trimesh

from neilfpp_method.export.asset.surface import AssetSurface, creased, first_hits, hits_along_normals

__all__ = ["Distance", "Simplified", "distance_between", "simplified"]

SAMPLES = 20_000
"""Number of points of the fine surface at which the distance is measured."""
PERCENTILE = 99.0
"""Percentile of the distances that is reported."""
MAX_MISSED = 0.02
"""Largest accepted fraction of points without a coarse surface nearby. Such points occur at borders, and at
planes that the decimation folds.
"""
MIN_FACES = 100
"""Least number of triangles; fewer would save nothing."""
REACH = 0.1
"""Largest distance at which the coarse surface is searched, scene units."""


@dataclass(frozen=True)
class Distance:
    """Distance from a fine surface to a coarse one.

    Attributes:
        near: 99th percentile of the distances, scene units.
        missed: fraction of points without a coarse surface within `REACH`.
    """

    near: float
    missed: float


@dataclass(frozen=True)
class Simplified:
    """A coarse surface, and the distance from the fine surface to it."""

    surface: AssetSurface
    distance: Distance


def simplified(fine: AssetSurface, max_faces: int, error: float) -> Simplified:
    """Reduce the number of triangles to `max_faces`, then halve it while the distance stays within `error`.

    Args:
        fine: the surface.
        max_faces: largest number of triangles, whatever the distance.
        error: largest distance that a further reduction may cause, scene units.
    """
    count = min(max_faces, len(fine.faces))
    best = _with_faces(fine, count)
    while count // 2 >= MIN_FACES:
        count //= 2
        fewer = _with_faces(fine, count)
        if fewer.distance.near > error or fewer.distance.missed > max(MAX_MISSED, best.distance.missed):
            break
        best = fewer
    return best


def distance_between(fine: AssetSurface, coarse: AssetSurface) -> Distance:
    """Measure the distance along the normals of the fine surface, at points spread uniformly over it."""
    points, face = trimesh.sample.sample_surface(fine.mesh(), SAMPLES, seed=0)
    normals = fine.mesh().face_normals[face]
    hits = hits_along_normals(coarse, first_hits(coarse), np.asarray(points), normals, REACH)
    distances = hits.distance[hits.valid]
    near = float(np.percentile(distances, PERCENTILE)) if len(distances) else REACH
    return Distance(near, 1 - len(distances) / SAMPLES)


def _with_faces(fine: AssetSurface, count: int) -> Simplified:
    """Decimate by quadric errors (Garland and Heckbert 1997)."""
    if count >= len(fine.faces):
        mesh = fine.mesh()
    else:
        vertices, faces = fast_simplification.simplify(
            fine.vertices.astype(np.float32), fine.faces.astype(np.int32), target_count=count
        )
        mesh = trimesh.Trimesh(vertices, faces, process=False)
    mesh.update_faces(mesh.nondegenerate_faces())
    mesh.remove_unreferenced_vertices()
    surface = creased(np.array(mesh.vertices, dtype=np.float64), np.array(mesh.faces))
    return Simplified(surface, distance_between(fine, surface))
