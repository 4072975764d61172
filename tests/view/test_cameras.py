"""Cameras of the browser are converted to cameras of the scene frame and back."""

from __future__ import annotations

import math

import numpy as np
import pytest
import torch

from neilfpp_method.data.cameras.projection import project
from neilfpp_method.view.cameras import MAX_SIDE, Pose, pinhole, pose_of

# Looks along world +x; its right is −y: x_cam = −y, y_cam = −z, z_cam = x.
ALONG_X = np.array([0.5, -0.5, 0.5, -0.5])


def test_a_point_projects_to_the_expected_pixel():
    camera = pinhole(Pose(np.array([-2.0, 0.0, 0.0]), ALONG_X, math.radians(90), 2.0), 400, 200)
    seen = project(camera, torch.tensor([[0.0, -0.5, 0.25]], dtype=torch.float64))
    # Focal length 100; 2 ahead, 0.5 to the right, 0.25 up.
    assert seen.pixel[0].tolist() == pytest.approx([200 + 100 * 0.25, 100 - 100 * 0.125])
    assert seen.depth.item() == pytest.approx(2.0)


def test_a_pose_is_converted_back():
    pose = pose_of(pinhole(Pose(np.array([1.0, 2.0, 3.0]), ALONG_X, 0.7, 1.5), 300, 200))
    assert pose.position.tolist() == pytest.approx([1, 2, 3])
    assert abs(pose.wxyz @ ALONG_X) == pytest.approx(1)
    assert (pose.fov, pose.aspect) == pytest.approx((0.7, 1.5))


def test_large_windows_have_smaller_images_of_the_same_view():
    camera = pinhole(Pose(np.zeros(3), ALONG_X, 0.7, 2.0), 4 * MAX_SIDE, 2 * MAX_SIDE)
    assert (camera.width, camera.height) == (MAX_SIDE, MAX_SIDE // 2)
    assert 2 * math.atan(camera.height / 2 / camera.fy) == pytest.approx(0.7)


def test_a_window_without_a_size_has_one_pixel():
    camera = pinhole(Pose(np.zeros(3), ALONG_X, 0.7, 1.0), 0, 0)
    assert (camera.width, camera.height) == (1, 1)
