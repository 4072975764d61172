"""A surface with fewer triangles, as near to the fine one as is asked for."""

from __future__ import annotations

from dataclasses import dataclass

import fast_simplification
import numpy as np
import trimesh

from neilfpp_method.export.asset.surface import Surface, creased, first_hits, meet_along

__all__ = ["Distance", "Simplified", "distance_between", "simplified"]

SAMPLES = 20_000
"""Points of the fine surface whose distance is measured."""
SHARE = 99.0
"""Per cent of them that are at most at the distance that is reported."""
MAX_MISSED = 0.02
"""Share of points that may have nothing near: beside borders, and where decimation folds a plane."""
MIN_FACES = 100
"""Triangles below which nothing is gained."""
REACH = 0.1
"""Scene units, beyond which nothing is near."""


@dataclass(frozen=True)
class Distance:
    """How far a fine surface is from a coarse one near it, scene units, and the share that has none near."""

    near: float
    missed: float


@dataclass(frozen=True)
class Simplified:
    """The coarse surface, and how far the fine one is from it."""

    surface: Surface
    distance: Distance


def simplified(fine: Surface, most_faces: int, error: float) -> Simplified:
    """A copy of at most so many triangles, and half as many, a quarter, … as long as it stays near.

    Args:
        fine: the surface.
        most_faces: a limit that holds whatever the error.
        error: the largest distance that fewer triangles than that may cause, scene units.
    """
    count = min(most_faces, len(fine.faces))
    best = _with_faces(fine, count)
    while count // 2 >= MIN_FACES:
        count //= 2
        fewer = _with_faces(fine, count)
        if fewer.distance.near > error or fewer.distance.missed > max(MAX_MISSED, best.distance.missed):
            break
        best = fewer
    return best


def distance_between(fine: Surface, coarse: Surface) -> Distance:
    """Along the normals of the fine surface, at points that are spread evenly over it."""
    points, face = trimesh.sample.sample_surface(fine.mesh(), SAMPLES, seed=0)
    normals = fine.mesh().face_normals[face]
    footing = meet_along(coarse, first_hits(coarse), np.asarray(points), normals, REACH)
    found = footing.distance[footing.found]
    near = float(np.percentile(found, SHARE)) if len(found) else REACH
    return Distance(near, 1 - len(found) / SAMPLES)


def _with_faces(fine: Surface, count: int) -> Simplified:
    """Quadric error decimation (Garland and Heckbert 1997)."""
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
