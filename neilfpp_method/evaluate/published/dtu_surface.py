"""Points of a surface, and their distances, as jzhangbs/DTUeval-python `eval.py` takes them; all in
millimetres.
"""

from __future__ import annotations

import numpy as np
from jaxtyping import Bool, Float, Int
from scipy.spatial import cKDTree

__all__ = ["capped_mean", "surface_samples", "thinned"]

AT_ONCE = 50_000
"""Points whose neighbours are asked together: bounds the memory."""


def surface_samples(
    vertices: Float[np.ndarray, "V 3"], faces: Int[np.ndarray, "F 3"], spacing: float
) -> Float[np.ndarray, "P 3"]:
    """The vertices, and a lattice of points on each triangle.

    A triangle of area A with edges of lengths l₁, l₂ from its first corner has ⌊l₁/t⌋ by ⌊l₂/t⌋ cells,
    t = spacing √(l₁ l₂ / 2A). Points at i + ½ cells, i up to and including their number, count where they lie
    inside of it. Triangles without an area have none.
    """
    corners = vertices[faces].astype(np.float64)
    along = corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]
    double_area = np.linalg.norm(np.cross(*along), axis=-1)
    rows = double_area > 0
    first, second, start = along[0][rows], along[1][rows], corners[rows, 0]
    lengths = np.linalg.norm(first, axis=-1), np.linalg.norm(second, axis=-1)
    cell = spacing * np.sqrt(lengths[0] * lengths[1] / double_area[rows])
    counts = np.stack([np.floor(length / cell) for length in lengths], axis=-1).astype(int)
    samples = [vertices.astype(np.float64)]
    kinds, kind_of = np.unique(counts, axis=0, return_inverse=True)
    for i, (across, down) in enumerate(kinds):
        if across and down:  # without a cell along an edge, no point lies inside
            u, v = (np.mgrid[: across + 1, : down + 1] + 0.5).reshape(2, -1)
            u, v = u / across, v / down
            inside = u + v < 1
            here = kind_of.reshape(-1) == i
            points = (
                start[here, None] + first[here, None] * u[inside, None] + second[here, None] * v[inside, None]
            )
            samples.append(points.reshape(-1, 3))
    return np.concatenate(samples)


def thinned(points: Float[np.ndarray, "P 3"], spacing: float, seed: int) -> Float[np.ndarray, "Q 3"]:
    """Points of which no two are closer than the spacing: in random order, each that is kept removes the
    others within that distance.
    """
    order = np.random.default_rng(seed).permutation(len(points))
    shuffled = points[order]
    tree = cKDTree(shuffled)
    kept: Bool[np.ndarray, " P"] = np.ones(len(points), bool)
    for begin in range(0, len(points), AT_ONCE):
        neighbours = tree.query_ball_point(shuffled[begin : begin + AT_ONCE], spacing)
        for i, near in enumerate(neighbours, begin):
            if kept[i]:
                kept[near] = False
                kept[i] = True
    return shuffled[kept]


def capped_mean(
    points: Float[np.ndarray, "P 3"], surface: Float[np.ndarray, "Q 3"], cap: float
) -> float | None:
    """The mean distance to the nearest point of the surface; points at the cap or beyond are left out of it.
    None where no point is nearer.
    """
    distance = cKDTree(surface).query(points)[0]
    near = distance[distance < cap]
    return float(near.mean()) if len(near) else None
