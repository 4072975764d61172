"""Convert between the browser's cameras and `Camera`; both have OpenCV axes."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float
from scipy.spatial.transform import Rotation

from neilfpp_method.data.cameras.camera import Camera

__all__ = ["Pose", "pinhole", "pose_of"]

MAX_SIDE = 1600
"""Largest width and height of an image, pixels; in a larger window it is enlarged."""


@dataclass(frozen=True)
class Pose:
    """Pose and field of view of a camera in the browser.

    Attributes:
        position: position, scene frame.
        wxyz: orientation as a unit quaternion, camera to scene.
        fov: vertical field of view, radians.
        aspect: width over height.
    """

    position: Float[np.ndarray, " 3"]
    wxyz: Float[np.ndarray, " 4"]
    fov: float
    aspect: float


def pinhole(pose: Pose, width: int, height: int) -> Camera:
    """Build the camera for a window of width × height pixels, reduced to `MAX_SIDE`."""
    factor = min(1.0, MAX_SIDE / max(width, height, 1))
    width, height = max(1, round(width * factor)), max(1, round(height * factor))
    rotation = Rotation.from_quat(np.roll(pose.wxyz, -1)).as_matrix().T
    w2c = np.eye(4)
    w2c[:3, :3], w2c[:3, 3] = rotation, -rotation @ pose.position
    focal = height / (2 * math.tan(pose.fov / 2))
    return Camera(focal, focal, width / 2, height / 2, width, height, w2c)


def pose_of(camera: Camera) -> Pose:
    """Convert a camera to a pose. Lens distortion and the offset of the principal point are ignored."""
    pose = camera.c2w
    wxyz = np.roll(Rotation.from_matrix(pose[:, :3]).as_quat(), 1)
    fov = 2 * math.atan(camera.height / (2 * camera.fy))
    return Pose(pose[:, 3], wxyz, fov, camera.width / camera.height)
