"""The surface of an asset: visible parts without small components and small holes."""

from __future__ import annotations

import numpy as np
import pytest
import trimesh

from neilfpp_method.data.cameras.camera import Camera
from neilfpp_method.errors import UserError
from neilfpp_method.export.asset.clean import HOLE, clean, close_holes, keep_visible, remove_small_components
from neilfpp_method.export.asset.surface import AssetSurface, creased, first_hits, hits_along_normals
from neilfpp_method.export.asset.visible import visible_faces

CAPS = [(np.array([0.0, 0.0, 0.5]), 0.06), (np.array([0.5, 0.0, 0.0]), 0.2)]


def surface(*shapes: trimesh.Trimesh) -> AssetSurface:
    whole = trimesh.util.concatenate(shapes) if len(shapes) > 1 else shapes[0]
    return creased(np.array(whole.vertices, dtype=np.float64), np.array(whole.faces))


def camera(height: float, size: int = 40) -> Camera:
    """A camera at (0, 0, height) that looks down, with a field of view of 53°."""
    w2c = np.diag([1.0, -1.0, -1.0, 1.0])
    w2c[2, 3] = height
    return Camera(float(size), float(size), size / 2, size / 2, size, size, w2c)


def ball(center: tuple[float, float, float], radius: float, subdivisions: int = 3) -> trimesh.Trimesh:
    shape = trimesh.creation.icosphere(subdivisions=subdivisions, radius=radius)
    shape.apply_translation(center)
    return shape


# ------------------------------------------------------------------------------------------------- who saw it


@pytest.mark.parametrize("size", [2, 40])
def test_a_camera_above_sees_the_upper_part(size):
    """Also if triangles are much smaller than its pixels."""
    shape = surface(ball((0, 0, 0), 0.5))
    seen = visible_faces(shape, [camera(2.0, size)])
    # From 2 the horizon of a ball of radius 0.5 is at z = 0.5² / 2; triangles are 0.08 across.
    middle = shape.mesh().triangles_center[:, 2]
    assert seen[middle > 0.125 + 0.04].all()
    assert not seen[middle < 0.125 - 0.04].any()


def test_surfaces_behind_the_camera_or_outside_the_image_are_invisible():
    near, behind, beside = ball((0, 0, 0), 0.5), ball((0, 0, -0.9), 0.2), ball((3, 0, 0), 0.2)
    seen = visible_faces(surface(near, behind, beside), [camera(2.0)])
    first, second, third = np.split(seen, np.cumsum([len(near.faces), len(behind.faces)]))
    assert first.any()
    assert not second.any()
    assert not third.any()


def test_the_inside_of_a_surface_is_invisible():
    turned = ball((0, 0, 0), 0.5)
    turned.invert()
    assert not visible_faces(surface(turned), [camera(2.0)]).any()


# ----------------------------------------------------------------------------------------------- what is kept


def test_invisible_patches_are_removed_unless_they_are_small():
    shape = surface(ball((0, 0, 0), 0.5, 4))
    z = shape.mesh().triangles_center[:, 2]
    # An invisible cap with a diameter of 0.04 is kept; below the equator only a ring is kept.
    top = shape.mesh().triangles_center[z.argmax()]
    seen = (z > 0) & (np.linalg.norm(shape.mesh().triangles_center - top, axis=1) > 0.4 * HOLE)
    kept = keep_visible(shape, seen).mesh()
    assert kept.triangles_center[:, 2].min() > -0.1
    assert 2 * np.pi * 0.25 < kept.area < 2 * np.pi * 0.25 + 2 * np.pi * 0.5 * 0.06
    assert (np.linalg.norm(kept.triangles_center - top, axis=1) < 1e-9).any()


def test_small_components_are_removed():
    kept = remove_small_components(surface(ball((0, 0, 0), 0.5), ball((1, 0, 0), 0.1), ball((0, 1, 0), 0.01)))
    assert kept.mesh().bounds[:, 0] == pytest.approx([-0.5, 1.1], abs=0.01)
    assert kept.mesh().bounds[1, 1] < 0.6


def test_small_holes_are_closed_and_large_ones_kept():
    whole = surface(ball((0, 0, 0), 0.5, 5))
    middle = whole.mesh().triangles_center
    holes = (np.linalg.norm(middle - [0, 0, 0.5], axis=1) < 0.02) | (middle[:, 2] < -0.4)
    closed = close_holes(whole.part(~holes))
    added = closed.faces[(~holes).sum() :]
    assert 5 <= len(added) < 40
    mesh = trimesh.Trimesh(closed.vertices, closed.faces, process=False)
    assert mesh.is_winding_consistent
    # The small hole is closed, and its triangles face up.
    np.testing.assert_allclose(mesh.face_normals[-len(added) :, 2], 1, atol=0.02)
    tracer = first_hits(closed)
    for height, met in ((1.0, True), (-1.0, False)):
        found = hits_along_normals(
            closed, tracer, np.array([[0.004, 0.003, height]]), np.array([[0.0, 0.0, np.sign(height)]]), 0.7
        )
        assert found.valid[0] == met


@pytest.mark.parametrize(("hole", "patches"), [(0.0, 0), (0.2, 1), (0.6, 2)])
def test_the_size_of_closed_holes_is_an_option(hole, patches):
    """Caps with diameters of 0.12 and 0.4 are unseen, and are kept or removed like holes."""
    shape = surface(ball((0, 0, 0), 0.5, 5))
    middle = shape.mesh().triangles_center
    caps = [np.linalg.norm(middle - place, axis=1) < width for place, width in CAPS]
    seen = ~(caps[0] | caps[1])
    kept = keep_visible(shape, seen, hole).mesh()
    assert (
        sum(np.linalg.norm(kept.triangles_center - place, axis=1).min() < 0.02 for place, _ in CAPS)
        == patches
    )
    closed = close_holes(shape.part(seen), hole)
    assert len(closed.vertices) - len(shape.vertices) == patches
    assert len(clean(shape, seen, hole).faces) == len(kept.faces)


def test_no_visible_triangle_is_an_error():
    shape = surface(ball((0, 0, 0), 0.5))
    with pytest.raises(UserError, match="no training camera sees the surface"):
        clean(shape, np.zeros(len(shape.faces), dtype=bool))


# ------------------------------------------------------------------------------------- the surface of a point


def test_points_are_moved_to_the_surface_of_the_same_orientation():
    """Between two plates, above the lower one."""
    plates = trimesh.util.concatenate([trimesh.creation.box((1, 1, 0.02)) for _ in range(2)])
    plates.vertices[8:, 2] += 0.1
    shape = surface(plates)
    found = hits_along_normals(
        shape, first_hits(shape), np.array([[0.1, 0.2, 0.03]]), np.array([[0.0, 0.0, 1.0]]), 0.2
    )
    assert found.valid.all()
    np.testing.assert_allclose(found.position, [[0.1, 0.2, 0.01]], atol=1e-6)
    np.testing.assert_allclose(found.distance, 0.02, atol=1e-6)
    np.testing.assert_allclose(found.normal, [[0, 0, 1]], atol=1e-6)
    short = hits_along_normals(
        shape, first_hits(shape), np.array([[0.1, 0.2, 0.03]]), np.array([[0.0, 0.0, 1.0]]), 0.015
    )
    assert not short.valid.any()
    np.testing.assert_allclose(short.position, [[0.1, 0.2, 0.03]], atol=1e-6)
