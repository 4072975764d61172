"""Between the browser's camera and ours; both have OpenCV axes."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float
from scipy.spatial.transform import Rotation

from neilfpp_method.data.views import Camera

__all__ = ["Pose", "pinhole", "pose_of"]

MAX_SIDE = 1600
"""Pixels: larger windows show a picture of this size enlarged."""


@dataclass(frozen=True)
class Pose:
    """Where a camera stands, its orientation (w x y z), and its vertical field of view in radians."""

    position: Float[np.ndarray, " 3"]
    wxyz: Float[np.ndarray, " 4"]
    fov: float
    aspect: float


def pinhole(pose: Pose, width: int, height: int) -> Camera:
    """The camera of a window of width × height pixels."""
    share = min(1.0, MAX_SIDE / max(width, height, 1))
    width, height = max(1, round(width * share)), max(1, round(height * share))
    rotation = Rotation.from_quat(np.roll(pose.wxyz, -1)).as_matrix().T
    w2c = np.eye(4)
    w2c[:3, :3], w2c[:3, 3] = rotation, -rotation @ pose.position
    focal = height / (2 * math.tan(pose.fov / 2))
    return Camera(focal, focal, width / 2, height / 2, width, height, w2c)


def pose_of(camera: Camera) -> Pose:
    """A camera's pose; its lens is taken for straight and its principal point for the middle."""
    pose = camera.c2w
    wxyz = np.roll(Rotation.from_matrix(pose[:, :3]).as_quat(), 1)
    return Pose(
        pose[:, 3], wxyz, 2 * math.atan(camera.height / (2 * camera.fy)), camera.width / camera.height
    )
