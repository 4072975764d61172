"""Surface samples and distances between point sets as in jzhangbs/DTUeval-python `eval.py`; millimetres."""

from __future__ import annotations

import numpy as np
from jaxtyping import Bool, Float, Int

from neilfpp_method.data.kd_tree import kd_tree

__all__ = ["capped_mean", "surface_samples", "thinned"]

POINTS_AT_ONCE = 50_000
"""Number of points per neighbour query, which bounds the memory."""


def surface_samples(
    vertices: Float[np.ndarray, "V 3"], faces: Int[np.ndarray, "F 3"], spacing: float
) -> Float[np.ndarray, "P 3"]:
    """Return the vertices and a lattice of points on each triangle.

    A triangle of area A whose first two edges have lengths l₁ and l₂ gets ⌊l₁/t⌋ by ⌊l₂/t⌋ cells with
    t = spacing √(l₁ l₂ / 2A). Lattice points lie at i + ½ cells, for i from 0 to the number of cells
    inclusive; those outside of the triangle are dropped. A triangle with zero area gets no points.
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
        # Without a cell along an edge, no lattice point lies inside of the triangle.
        if across and down:
            u, v = (np.mgrid[: across + 1, : down + 1] + 0.5).reshape(2, -1)
            u, v = u / across, v / down
            inside = u + v < 1
            u, v = u[inside, None], v[inside, None]
            same = kind_of.reshape(-1) == i
            points = start[same, None] + first[same, None] * u + second[same, None] * v
            samples.append(points.reshape(-1, 3))
    return np.concatenate(samples)


def thinned(points: Float[np.ndarray, "P 3"], spacing: float, seed: int) -> Float[np.ndarray, "Q 3"]:
    """Remove points until no two are closer than the spacing.

    Points are visited in random order; each point that is kept removes all others within the spacing.
    """
    order = np.random.default_rng(seed).permutation(len(points))
    shuffled = points[order]
    tree = kd_tree(shuffled)
    kept: Bool[np.ndarray, " P"] = np.ones(len(points), bool)
    for begin in range(0, len(points), POINTS_AT_ONCE):
        neighbors = tree.query_ball_point(shuffled[begin : begin + POINTS_AT_ONCE], spacing)
        for i, near in enumerate(neighbors, begin):
            if kept[i]:
                kept[near] = False
                kept[i] = True
    return shuffled[kept]


def capped_mean(
    points: Float[np.ndarray, "P 3"], surface: Float[np.ndarray, "Q 3"], cap: float
) -> float | None:
    """Mean distance to the nearest point of `surface` over the points that are nearer than `cap`.

    None if there is no such point.
    """
    distance = kd_tree(surface).query(points)[0]
    near = distance[distance < cap]
    return float(near.mean()) if len(near) else None
