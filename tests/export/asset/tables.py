"""Surfaces of a table top with three objects, as from a modelling program and as from marching cubes."""

from __future__ import annotations

import numpy as np
import trimesh
from skimage.measure import marching_cubes

from neilfpp_method.export.asset.surface import AssetSurface, creased

TOP, CUBE = (0.8, 0.8, 0.05), (0.15, 0.15, 0.15)
"""Half sizes of the table top and the cube on it."""
CUBE_AT, BALL_AT, RING_AT = (
    np.array([0.4, 0.3, 0.21]),
    np.array([-0.4, 0.0, 0.26]),
    np.array([0.3, -0.4, 0.12]),
)
BALL, RING, TUBE = 0.2, 0.2, 0.06
"""Radii of the ball, and of the ring and its tube."""
LOWEST = -0.03
"""Cameras see nothing of the table below."""


def modelled() -> AssetSurface:
    """Flat parts of many small triangles; the objects float 0.01 above the top."""
    top, cube = (trimesh.creation.box(2 * np.array(half)) for half in (TOP, CUBE))
    ball = trimesh.creation.icosphere(subdivisions=5, radius=BALL)
    ring = trimesh.creation.torus(RING, TUBE, major_sections=96, minor_sections=48)
    parts = []
    for part, at in ((top, np.zeros(3)), (cube, CUBE_AT), (ball, BALL_AT), (ring, RING_AT)):
        vertices, faces = trimesh.remesh.subdivide_to_size(part.vertices, part.faces, 0.03, max_iter=20)
        parts.append(trimesh.Trimesh(vertices + at, faces))
    return _seen(trimesh.util.concatenate(parts))


def scanned(points: int = 144, noise: float = 0.03) -> AssetSurface:
    """The same from distances on a grid, with noise in parts of a cell."""
    axis = np.linspace(-1, 1, points)
    place = np.stack(np.meshgrid(axis, axis, axis, indexing="ij"), axis=-1)

    def box(center: np.ndarray, half: tuple[float, float, float]) -> np.ndarray:
        outside = np.abs(place - center) - half
        return np.linalg.norm(outside.clip(0), axis=-1) + outside.max(-1).clip(max=0)

    around = place - RING_AT
    tube = np.hypot(np.hypot(around[..., 0], around[..., 1]) - RING, around[..., 2]) - TUBE
    ball = np.linalg.norm(place - BALL_AT, axis=-1) - BALL
    distance = np.minimum.reduce([box(np.zeros(3), TOP), box(CUBE_AT, CUBE), ball, tube])
    step = axis[1] - axis[0]
    distance += noise * step * np.random.default_rng(0).standard_normal(distance.shape)
    vertices, faces, _, _ = marching_cubes(distance.astype(np.float32), 0.0, allow_degenerate=False)
    return _seen(trimesh.Trimesh(vertices * step - 1, faces, process=False))


def _seen(mesh: trimesh.Trimesh) -> AssetSurface:
    mesh.update_faces(mesh.triangles_center[:, 2] > LOWEST)
    mesh.remove_unreferenced_vertices()
    return creased(np.array(mesh.vertices, np.float64), np.array(mesh.faces))
