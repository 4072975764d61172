"""Simplified surfaces stay within the stated error of the full ones, in both directions and everywhere."""

from __future__ import annotations

import numpy as np
import pytest
import trimesh

from neilfpp_method.export.asset import simplify
from neilfpp_method.export.asset.simplify import Distance, _to_nearest, distance_between, simplified
from neilfpp_method.export.asset.surface import AssetSurface, creased
from tests.export.asset.tables import modelled, scanned

POINTS_AT_ONCE = 100
MISSED, MARGIN = 0.001, 1.25
"""Largest share of points outside of the error, and a factor of the error, because other points are used here
than those that `simplified` measures.
"""


@pytest.fixture(scope="module", params=[modelled, scanned])
def table(request) -> AssetSurface:
    return request.param()


def ball(radius: float, subdivisions: int = 5) -> AssetSurface:
    shape = trimesh.creation.icosphere(subdivisions=subdivisions, radius=radius)
    return creased(np.array(shape.vertices, np.float64), np.array(shape.faces))


def missed(one: AssetSurface, other: AssetSurface, error: float, count: int = 4000) -> float:
    """Share of random points of a surface from which no triangle of the other one that faces the same way is
    within the error. All triangles whose bounding box is near are tested.
    """
    points, face = trimesh.sample.sample_surface(one.mesh(), count, seed=7)
    order = np.argsort(np.asarray(points)[:, 0])
    points, normals = np.asarray(points)[order], one.mesh().face_normals[face][order]
    corners, facing = other.vertices[other.faces], other.mesh().face_normals
    low, high = corners.min(1) - error, corners.max(1) + error
    near = np.zeros(count, bool)
    for first in range(0, count, POINTS_AT_ONCE):
        some = points[first : first + POINTS_AT_ONCE, None]
        beside = np.flatnonzero((low[:, 0] < some[-1, 0, 0]) & (high[:, 0] > some[0, 0, 0]))
        point, triangle = np.nonzero(((some > low[beside]) & (some < high[beside])).all(-1))
        point, triangle = point + first, beside[triangle]
        same = (normals[point] * facing[triangle]).sum(-1) > 0
        point, triangle = point[same], triangle[same]
        nearest = trimesh.triangles.closest_point(corners[triangle], points[point])
        near[point[np.linalg.norm(nearest - points[point], axis=1) <= error]] = True
    return 1 - near.mean()


# ------------------------------------------------------------------------------------------------- table tops


@pytest.mark.parametrize(("faces", "error"), [(30_000, 0.001), (3_000, 0.005)])
def test_a_table_top_keeps_all_of_its_parts(table, faces, error):
    """Measured errors: 0.0002 with 30,000 triangles, and up to 0.0034 with 3,000."""
    coarse = simplified(table, faces, error)
    assert len(coarse.surface.faces) <= faces < len(table.faces)
    assert coarse.distance.near <= error
    assert missed(table, coarse.surface, MARGIN * error) < MISSED
    assert missed(coarse.surface, table, MARGIN * error) < MISSED


def test_the_error_is_kept_before_the_number_of_triangles(table):
    coarse = simplified(table, 1_500, 0.001)
    assert 1_500 < len(coarse.surface.faces) < len(table.faces)
    assert coarse.distance.near <= 0.001 < coarse.wished.near
    assert missed(table, coarse.surface, MARGIN * 0.001) < MISSED
    assert missed(coarse.surface, table, MARGIN * 0.001) < MISSED
    # The error that is reported for 1,500 triangles is one with which there are no more.
    assert len(simplified(table, 1_500, coarse.wished.near).surface.faces) <= 1_500


def test_the_number_of_triangles_can_be_kept_first(table):
    coarse = simplified(table, 1_000, 0.001, faces_first=True)
    assert len(coarse.surface.faces) <= 1_000
    assert coarse.distance.near > 0.001


# ------------------------------------------------------------------------------------------------- the number


def test_the_number_of_triangles_depends_on_the_error():
    fine = ball(0.5)
    sizes = []
    for error in (0.0005, 0.003, 0.02):
        coarse = simplified(fine, 5000, error)
        assert coarse.distance.near <= error
        # The centre of a triangle with edges of length e lies e²/(6 r) below its corners, which all of them
        # must keep.
        sphere = np.linalg.norm(coarse.surface.mesh().triangles_center, axis=1)
        assert np.abs(sphere - 0.5).mean() <= error
        sizes.append(len(coarse.surface.faces))
    assert sizes[0] > 5000 > sizes[1] > sizes[2]


def test_there_is_a_largest_number_of_triangles(monkeypatch):
    monkeypatch.setattr(simplify, "MAX_FACES", 8000)
    coarse = simplified(ball(0.5), 5000, 1e-7)
    assert 7000 < len(coarse.surface.faces) <= 8000
    assert coarse.distance.near > 1e-7


def test_an_error_of_zero_keeps_every_triangle():
    fine = ball(0.5, 4)
    coarse = simplified(fine, 1000, 0.0)
    assert len(coarse.surface.faces) == len(fine.faces)
    assert coarse.distance == Distance(0.0, 0.0)


def test_a_coarse_surface_is_unchanged():
    shape = trimesh.creation.box((1, 1, 1))
    box = creased(np.array(shape.vertices, np.float64), np.array(shape.faces))
    kept = simplified(box, 5000, 0.0)
    assert len(kept.surface.faces) == 12
    # Edges stay edges: each corner has the normal of its side.
    np.testing.assert_allclose(
        kept.surface.normals, np.repeat(shape.face_normals[:, None], 3, axis=1), atol=1e-6
    )


# ----------------------------------------------------------------------------------------------- the distance


def test_the_distance_is_that_between_the_surfaces():
    one, other = ball(0.5), ball(0.51)
    assert distance_between(one, other).near == pytest.approx(0.01, abs=3e-4)
    assert distance_between(one, other).largest == pytest.approx(0.01, abs=3e-4)
    assert distance_between(one, one).largest == pytest.approx(0, abs=1e-5)


@pytest.mark.parametrize("swapped", [False, True])
def test_missing_parts_count_in_both_directions(swapped):
    """The pole of a ball is √(2 r h) from the rim of a missing cap of height h."""
    whole = ball(0.5)
    pair = (whole, whole.part(whole.mesh().triangles_center[:, 2] < 0.45))
    found = distance_between(*(pair[::-1] if swapped else pair))
    assert found.largest == pytest.approx(np.sqrt(2 * 0.5 * 0.05), rel=0.1)
    assert found.near > 0.15


def test_a_part_that_faces_the_other_way_is_no_substitute():
    """A plate without one of its sides."""
    shape = trimesh.creation.box((1, 1, 0.02))
    plate = creased(np.array(shape.vertices, np.float64), np.array(shape.faces))
    assert distance_between(plate, plate.part(shape.face_normals[:, 2] < 0.5)).largest == np.inf


def test_the_nearest_triangle_is_that_among_all_which_face_the_same_way(monkeypatch):
    """Triangles of random sizes; the definition tests all pairs. Small parts are computed at once, and one
    neighbour is often not enough.
    """
    monkeypatch.setattr(simplify, "PAIRS_AT_ONCE", 100)
    monkeypatch.setattr(simplify, "NEIGHBORS", 2)
    random = np.random.default_rng(0)
    center, size = random.uniform(-1, 1, (60, 1, 3)), random.uniform(0.01, 0.8, (60, 1, 1))
    corners = center + size * random.uniform(-1, 1, (60, 3, 3))
    # No triangle faces down.
    normal = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    corners[normal[:, 2] < 0] = corners[normal[:, 2] < 0][:, ::-1]
    surface = creased(corners.reshape(-1, 3), np.arange(180).reshape(-1, 3))
    points, normals = random.uniform(-1.5, 1.5, (90, 3)), random.normal(size=(90, 3))
    normals[:10] = 0, 0, -1
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)

    expected = np.full(len(points), np.inf)
    for row, (point, normal) in enumerate(zip(points, normals, strict=True)):
        same = corners[surface.mesh().face_normals @ normal > 0]
        if len(same):
            nearest = trimesh.triangles.closest_point(same, np.tile(point, (len(same), 1)))
            expected[row] = np.linalg.norm(nearest - point, axis=1).min()
    assert np.isinf(expected).sum() == 10
    np.testing.assert_allclose(_to_nearest(surface, points, normals), expected, rtol=1e-9)
    assert np.isinf(_to_nearest(surface, points[:10], normals[:10])).all()
