"""Up is found again after the world has been turned, for rings of cameras, half rings and a single one."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from neilfpp_method.prepare.upright import upright_rotation
from tests.prepare.textured_corner import pose


def ring(views: int, arc: float) -> np.ndarray:
    return np.stack([pose(i, views, arc)[:3, :3] for i in range(views)])


@pytest.mark.parametrize("arc", [360.0, 180.0, 60.0])
def test_level_cameras_tell_up(arc):
    turn = Rotation.from_rotvec([0.4, -1.1, 0.7]).as_matrix()
    found = upright_rotation(ring(12, arc) @ turn.T)
    np.testing.assert_allclose(found @ turn @ [0, 0, 1], [0, 0, 1], atol=1e-9)
    np.testing.assert_allclose(found @ found.T, np.eye(3), atol=1e-12)
    assert np.linalg.det(found) == pytest.approx(1.0)


def test_cameras_that_all_look_alike_have_their_own_up():
    rotations = np.repeat(pose(3, 9)[None, :3, :3], 4, axis=0)
    up = upright_rotation(rotations) @ -rotations[0, 1]
    np.testing.assert_allclose(up, [0, 0, 1], atol=1e-9)


def test_cameras_that_contradict_one_another_leave_the_world_as_it_is():
    down = np.diag([1.0, -1.0, -1.0])
    np.testing.assert_array_equal(upright_rotation(np.stack([np.eye(3), down])), np.eye(3))
