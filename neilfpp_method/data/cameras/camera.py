"""A camera: its intrinsics, its pose, and the check of both.

Cameras have OpenCV axes (x right, y down, z forward). The centre of pixel (column, row) is the image point
(column + ½, row + ½). A camera without a `Lens` is a pinhole camera.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Float64

from neilfpp_method.data.cameras.lens import Lens
from neilfpp_method.errors import UserError

__all__ = ["POSE_MISTAKES", "Camera", "check_camera", "scaled_camera"]

MIN_FOCAL, LARGEST = 1e-3, 1e12
"""Smallest focal length, in pixels, and largest absolute value of any number of a camera, so that rays can be
computed in float32."""

POSE_MISTAKES = (
    "the axes may be of another convention (OpenCV: y down, z forward; OpenGL: y up, z back), or the poses "
    "inverted (world to camera)"
)
"""Common mistakes in the poses of all cameras, for the remedy of an error."""


@dataclass(frozen=True, eq=False)
class Camera:
    """Focal lengths, principal point and size in pixels, and the pose from world (or scene) to camera.

    Without `lens` it is a pinhole camera. With it, focal lengths and principal point apply to the distorted
    image plane. Cameras are compared by identity, because the comparison of arrays has no single truth value.
    """

    fx: float
    fy: float
    cx: float
    cy: float
    width: int
    height: int
    w2c: Float64[np.ndarray, "4 4"]
    lens: Lens | None = None

    @property
    def intrinsics(self) -> Float64[np.ndarray, " 4"]:
        """The numbers fx, fy, cx, cy."""
        return np.array([self.fx, self.fy, self.cx, self.cy])

    @property
    def c2w(self) -> Float64[np.ndarray, "3 4"]:
        """Camera to world: the transposed rotation, with the camera's centre as the last column."""
        rotation = self.w2c[:3, :3].T
        return np.concatenate([rotation, -rotation @ self.w2c[:3, 3:]], axis=1)


def scaled_camera(camera: Camera, width: int, height: int) -> Camera:
    """Return the camera with the same field of view and another number of pixels.

    >>> camera = Camera(500.0, 500.0, 200.0, 150.0, 400, 300, np.eye(4))
    >>> half = scaled_camera(camera, 200, 150)
    >>> half.fx, half.cx, half.cy
    (250.0, 100.0, 75.0)
    """
    right, down = width / camera.width, height / camera.height
    return replace(
        camera,
        fx=camera.fx * right,
        fy=camera.fy * down,
        cx=camera.cx * right,
        cy=camera.cy * down,
        width=width,
        height=height,
    )


def check_camera(camera: Camera, where: str) -> None:
    """Check that a camera has finite numbers in a usable range and a rigid pose.

    Args:
        camera: the camera.
        where: the file or view to which the camera belongs, for the message.

    Raises:
        UserError: it does not.
    """
    rotation = camera.w2c[:3, :3]
    if not (np.isfinite(camera.w2c).all() and np.isfinite(camera.intrinsics).all()):
        raise UserError(f"{where}: the camera has a number that is not finite", "export the cameras again")
    if min(camera.fx, camera.fy) <= 0:
        raise UserError(f"{where}: the focal length is not positive", "give the focal length in pixels")
    if min(camera.fx, camera.fy) < MIN_FOCAL or max(*abs(camera.intrinsics), abs(camera.w2c).max()) > LARGEST:
        raise UserError(
            f"{where}: the camera has a focal length below {MIN_FOCAL:g} px or a number beyond {LARGEST:g}",
            "export the cameras again",
        )
    if min(camera.width, camera.height) < 1:
        raise UserError(f"{where}: the image size is not positive", "give width and height in pixels")
    orthogonal = np.abs(rotation @ rotation.T - np.eye(3)).max() < 1e-3
    if not orthogonal or not np.allclose(camera.w2c[3], [0, 0, 0, 1]):
        raise UserError(
            f"{where}: the extrinsic matrix is not a rotation and a translation",
            "give world-to-camera, 4×4, row-major",
        )
    if np.linalg.det(rotation) < 0:
        raise UserError(
            f"{where}: the pose mirrors the scene (determinant −1)",
            "negate one axis of the camera: x points right, y down and z forward (OpenGL: y up and z back)",
        )
    if camera.lens is not None:
        camera.lens.check(where)
