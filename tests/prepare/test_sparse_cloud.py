"""Normals and outliers on a sphere, for which both are known."""

from __future__ import annotations

import numpy as np
import pycolmap

from neilfpp_method.data.point_cloud import WorldPoints
from neilfpp_method.prepare.sparse_cloud import (
    SparsePoints,
    estimate_normals,
    oriented,
    reliable,
    sparse_points,
    without_outliers,
)


def sphere(count: int = 2000, noise: float = 0.0) -> np.ndarray:
    rng = np.random.default_rng(0)
    direction = rng.normal(size=(count, 3))
    direction /= np.linalg.norm(direction, axis=1, keepdims=True)
    return direction * (1 + noise * rng.normal(size=(count, 1)))


def seen(position: np.ndarray) -> SparsePoints:
    outward = position / np.linalg.norm(position, axis=1, keepdims=True)
    return SparsePoints(position, np.full(len(position), 0.5), np.full(len(position), 5), outward)


def test_normals_point_towards_the_cameras():
    position = sphere(noise=0.002)
    for side in (1.0, -1.0):
        found = estimate_normals(position, side * position)
        angle = np.degrees(
            np.arccos(
                np.clip((found.normal * side * position).sum(1) / np.linalg.norm(position, axis=1), -1, 1)
            )
        )
        assert found.flat.mean() > 0.9
        assert np.quantile(angle[found.flat], 0.95) < 12


def test_points_that_are_not_flat_have_no_normal():
    position = np.random.default_rng(1).normal(size=(500, 3))
    assert estimate_normals(position, position).flat.mean() < 0.1


def test_isolated_and_inaccurate_points_are_left_out():
    good = sphere(1000)
    rng = np.random.default_rng(2)
    alone = 3.0 + rng.random((20, 3)) * 4
    position = np.concatenate([good, alone, good[:30] * 1.0001])
    points = seen(position)
    points.error[5], points.track[6] = 2.5, 2
    points.position[7] = np.nan
    kept = reliable(points)
    assert not kept[[5, 6, 7]].any()
    assert kept[:1000].sum() >= 985
    assert not kept[1000:1020].any()
    cloud = oriented(points)
    assert np.abs(np.linalg.norm(cloud.position, axis=1) - 1).max() < 1e-3
    np.testing.assert_allclose(np.linalg.norm(cloud.normal, axis=1), 1.0)


def test_too_few_points_give_no_cloud():
    assert len(oriented(seen(sphere(8))).position) == 0


def test_outliers_of_a_given_cloud():
    position = np.concatenate([sphere(1000), [[4.0, 0, 0], [0, 5.0, 1.0]]])
    cloud = without_outliers(WorldPoints(position, position))
    assert 985 <= len(cloud.position) <= 1000
    np.testing.assert_array_equal(cloud.position, cloud.normal)


def test_points_without_observations_are_left_out():
    model = pycolmap.Reconstruction()
    for point in sphere(50):
        model.add_point3D(point, pycolmap.Track(), np.zeros(3, np.uint8))
    points = sparse_points(model)
    assert len(points) == 50
    assert not points.towards.any()
    assert not reliable(points).any()
    assert len(oriented(points).position) == 0
