"""The up direction is recovered after the world has been rotated, for full rings of cameras, half rings and
single cameras.
"""

from __future__ import annotations

import numpy as np
import pycolmap
import pytest
from PIL import Image, ImageOps
from scipy.spatial.transform import Rotation

from neilfpp_method.prepare.upright import turn_upright, upright_rotation
from tests.prepare.textured_corner import pose


def ring(views: int, arc: float) -> np.ndarray:
    return np.stack([pose(i, views, arc)[:3, :3] for i in range(views)])


@pytest.mark.parametrize("arc", [360.0, 180.0, 60.0])
def test_level_cameras_define_up(arc):
    turn = Rotation.from_rotvec([0.4, -1.1, 0.7]).as_matrix()
    found = upright_rotation(ring(12, arc) @ turn.T)
    np.testing.assert_allclose(found @ turn @ [0, 0, 1], [0, 0, 1], atol=1e-9)
    np.testing.assert_allclose(found @ found.T, np.eye(3), atol=1e-12)
    assert np.linalg.det(found) == pytest.approx(1.0)


def pixel_after(orientation: int) -> np.ndarray:
    """Directions of the axes of a stored image, x right and y down, in the image that Pillow shows for an
    EXIF orientation.
    """
    axes = []
    for at in ((1, 0), (2, 0), (1, 1)):
        picture = Image.new("L", (5, 3))
        picture.putpixel(at, 255)
        picture.getexif()[0x0112] = orientation
        row, column = np.argwhere(np.asarray(ImageOps.exif_transpose(picture)))[0]
        axes.append(np.array([column, row]))
    return np.stack([axes[1] - axes[0], axes[2] - axes[0]], axis=1)


@pytest.mark.parametrize("orientation", [1, 3, 6, 8])
def test_cameras_on_their_side_define_up_by_their_orientation(orientation):
    shown = np.eye(3)
    shown[:2, :2] = pixel_after(orientation)
    turn = Rotation.from_rotvec([0.4, -1.1, 0.7]).as_matrix()
    model = pycolmap.Reconstruction()
    camera = pycolmap.Camera(model="SIMPLE_PINHOLE", width=5, height=3, params=[5, 2.5, 1.5], camera_id=1)
    model.add_camera_with_trivial_rig(camera)
    for i, upright in enumerate(ring(12, 360)):
        image = pycolmap.Image(name=f"{i}.png", camera_id=1, image_id=i + 1)
        rotation = pycolmap.Rotation3d(shown.T @ upright @ turn.T)
        model.add_image_with_trivial_frame(image, pycolmap.Rigid3d(rotation, np.array([0.0, 0.0, 3.0])))
    turn_upright(model, {f"{i}.png": orientation for i in range(12)})
    for i, image in model.images.items():
        # The same as before the rotation, except for a rotation about the up axis.
        back = (shown @ image.cam_from_world().rotation.matrix()).T @ ring(12, 360)[i - 1]
        np.testing.assert_allclose(back @ [0, 0, 1], [0, 0, 1], atol=1e-9)


def test_cameras_with_one_orientation_define_up_by_their_own():
    rotations = np.repeat(pose(3, 9)[None, :3, :3], 4, axis=0)
    up = upright_rotation(rotations) @ -rotations[0, 1]
    np.testing.assert_allclose(up, [0, 0, 1], atol=1e-9)


def test_contradictory_cameras_leave_the_world_unchanged():
    down = np.diag([1.0, -1.0, -1.0])
    np.testing.assert_array_equal(upright_rotation(np.stack([np.eye(3), down])), np.eye(3))
