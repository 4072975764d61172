"""Simplify a surface within a given distance."""

from __future__ import annotations

import itertools
from dataclasses import dataclass, replace

import fast_simplification
import numpy as np
import trimesh
from jaxtyping import Float
from scipy.spatial.distance import cdist

from neilfpp_method.data.kd_tree import kd_tree
from neilfpp_method.export.asset.surface import AssetSurface, creased, first_hits, hits_along_normals

__all__ = ["MAX_FACES", "MIN_FACES", "Distance", "Simplified", "decimated", "distance_between", "simplified"]

SAMPLES = 20_000
"""Number of points of each surface at which the distance to the other is measured."""
PERCENTILE = 99.9
"""Percentile of the distances that the error bounds. The largest one depends on where the points are."""
MIN_FACES = 100
"""Least number of triangles; fewer would save nothing."""
MAX_FACES = 200_000
"""Largest number of triangles; with more, xatlas takes minutes."""
REACH = 0.1
"""Largest distance at which the other surface is searched along a normal, scene units."""
NEIGHBORS = 16
"""Number of triangles around a point among which one that faces the same way is sought first."""
PAIRS_AT_ONCE = 200_000
"""Number of pairs of points and triangles that are computed at once; it bounds memory."""
WAYS = ((3.0, True), (4.0, True), (5.0, True), (7.0, False))
"""Aggressiveness of the decimation, and whether borders are kept; the first that reaches the number of
triangles is used. From about 7 on, triangles of planes fold, and without borders whole strips are lost.
"""


@dataclass(frozen=True)
class Distance:
    """Distance between two surfaces: of points of either one to the part of the other that faces the same
    way.

    Attributes:
        near: 99.9th percentile, scene units; the larger one of both directions.
        largest: largest distance, scene units; infinite if a point has no such part.
    """

    near: float
    largest: float


@dataclass(frozen=True)
class Simplified:
    """A coarse surface.

    Attributes:
        surface: the surface.
        distance: its distance from the fine surface.
        wished: the distance at the wished number of triangles.
    """

    surface: AssetSurface
    distance: Distance
    wished: Distance


def simplified(fine: AssetSurface, faces: int, error: float, faces_first: bool = False) -> Simplified:
    """Reduce the number of triangles as far as the distance stays within `error`.

    The number is `faces`, halved as often as the error permits. If `faces` triangles exceed the error, the
    number is doubled until they do not, or until it is `MAX_FACES`.

    Args:
        fine: the surface.
        faces: wished number of triangles.
        error: largest distance, scene units (`Distance.near`).
        faces_first: use at most `faces` triangles, whatever the distance.
    """
    count, most = min(faces, len(fine.faces)), min(MAX_FACES, len(fine.faces))
    best = _with_faces(fine, count)
    wished = best.distance
    if wished.near > error and not faces_first:
        while best.distance.near > error and count < most:
            count = min(2 * count, most)
            best = _with_faces(fine, count)
        return replace(best, wished=wished)
    while count // 2 >= MIN_FACES:
        count //= 2
        fewer = _with_faces(fine, count)
        if fewer.distance.near > error:
            break
        best = fewer
    return replace(best, wished=wished)


def distance_between(one: AssetSurface, other: AssetSurface) -> Distance:
    """Measure the distance from points that are spread uniformly over each surface to the other."""
    there, back = _distances(one, other), _distances(other, one)
    near = max(np.percentile(side, PERCENTILE, method="higher") for side in (there, back))
    return Distance(float(near), float(max(there.max(), back.max())))


def _distances(measured: AssetSurface, other: AssetSurface) -> Float[np.ndarray, " S"]:
    """Distances of points of a surface to another one, along their normals or to the nearest triangle.

    A normal misses the other surface beside its border, and where a part that faces the other way is nearer.
    """
    mesh = measured.mesh()
    points, face = trimesh.sample.sample_surface(mesh, SAMPLES, seed=0)
    points, normals = np.asarray(points), mesh.face_normals[face]
    hits = hits_along_normals(other, first_hits(other), points, normals, REACH)
    distances = np.where(hits.valid, hits.distance, np.inf).astype(np.float64)
    far = np.argsort(distances)[-max(np.count_nonzero(~hits.valid), SAMPLES // 100) :]
    distances[far] = np.minimum(distances[far], _to_nearest(other, points[far], normals[far]))
    return distances


def _to_nearest(
    surface: AssetSurface, points: Float[np.ndarray, "N 3"], normals: Float[np.ndarray, "N 3"]
) -> Float[np.ndarray, " N"]:
    """Distances of points to the nearest triangle that faces the same way; infinite if there is none."""
    triangles, facing = surface.vertices[surface.faces], surface.mesh().face_normals
    center = triangles.mean(axis=1)
    radius = np.linalg.norm(triangles - center[:, None], axis=-1).max(axis=1)
    distances = _to_center(center, facing, points, normals)
    rows = np.flatnonzero(np.isfinite(distances))
    # The nearest triangle is no farther than the nearest centre, and reaches its radius around its own. Each
    # size is searched for itself, because the radius of a large triangle would bring in many small ones.
    size = np.frexp(radius)[1]
    for faces in (np.flatnonzero(size == one) for one in np.unique(size)):
        tree, reach = kd_tree(center[faces]), (distances + radius[faces].max()) * (1 + 1e-9)
        pairs = np.cumsum(tree.query_ball_point(points[rows], reach[rows], return_length=True))
        for some in np.split(rows, np.flatnonzero(np.diff(pairs // PAIRS_AT_ONCE)) + 1):
            within = tree.query_ball_point(points[some], reach[some])
            row = np.repeat(some, [len(near) for near in within])
            face = faces[np.fromiter(itertools.chain.from_iterable(within), np.int64)]
            same = (facing[face] * normals[row]).sum(-1) > 0
            row, face = row[same], face[same]
            nearest = trimesh.triangles.closest_point(triangles[face], points[row])
            np.minimum.at(distances, row, np.linalg.norm(nearest - points[row], axis=-1))
    return distances


def _to_center(
    center: Float[np.ndarray, "F 3"],
    facing: Float[np.ndarray, "F 3"],
    points: Float[np.ndarray, "N 3"],
    normals: Float[np.ndarray, "N 3"],
) -> Float[np.ndarray, " N"]:
    """Distances of points to the nearest centre of a triangle that faces the same way; infinite if none does.

    Args:
        center: centres of the triangles.
        facing: their unit normals.
        points: the points.
        normals: unit normals of the points.
    """
    distance, near = kd_tree(center).query(points, range(1, min(NEIGHBORS, len(center)) + 1))
    same = np.einsum("nki,ni->nk", facing[near], normals) > 0
    distances = np.where(same, distance, np.inf).min(1)
    left, at_once = np.flatnonzero(np.isinf(distances)), max(1, PAIRS_AT_ONCE // len(center))
    for some in np.split(left, range(at_once, len(left), at_once)):
        same = normals[some] @ facing.T > 0
        distances[some] = np.where(same, cdist(points[some], center), np.inf).min(1)
    return distances


def decimated(fine: AssetSurface, count: int) -> AssetSurface:
    """Decimate by quadric errors (Garland and Heckbert 1997).

    There are more than `count` triangles if even the most aggressive of `WAYS` leaves more.
    """
    mesh = fine.mesh()
    for aggressiveness, keeps_borders in WAYS if count < len(fine.faces) else ():
        vertices, faces = fast_simplification.simplify(
            fine.vertices,
            fine.faces.astype(np.int32),
            target_count=count,
            agg=aggressiveness,
            preserve_border=keeps_borders,
        )
        mesh = trimesh.Trimesh(vertices, faces, process=False)
        if len(faces) <= count:
            break
    mesh.update_faces(mesh.nondegenerate_faces())
    mesh.remove_unreferenced_vertices()
    return creased(np.array(mesh.vertices, dtype=np.float64), np.array(mesh.faces))


def _with_faces(fine: AssetSurface, count: int) -> Simplified:
    """A surface with `count` triangles or fewer, and its distance."""
    surface = decimated(fine, count)
    distance = Distance(0.0, 0.0) if count >= len(fine.faces) else distance_between(fine, surface)
    return Simplified(surface, distance, distance)
