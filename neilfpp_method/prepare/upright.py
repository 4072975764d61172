"""Rotate the world frame so that +z is up.

The frame of structure from motion has an arbitrary rotation, but environment maps are defined about +z.
"""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
from jaxtyping import Float64

from neilfpp_method.data.cameras.colmap_library import pycolmap

__all__ = ["turn_upright", "upright_rotation"]

MIN_EIGENVALUE_RATIO = 0.1
"""Threshold of the test that camera x axes span a plane: the second eigenvalue of their second moment, whose
trace is 1, is larger than this, and the smallest one is smaller than this share of it."""

MIN_AGREEMENT = 0.1
"""Smallest absolute dot product of the normal of that plane with the mean up direction of the cameras, which
decides the sign of the normal."""

TURNS = {
    3: np.diag([-1.0, -1.0, 1.0]),
    6: np.array([[0.0, -1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, 1.0]]),
    8: np.array([[0.0, 1.0, 0.0], [-1.0, 0.0, 0.0], [0.0, 0.0, 1.0]]),
}
"""Rotations from the axes of the stored image to those of the upright image, by EXIF orientation: a camera
that is turned upside down (3) or on its side (6 and 8)."""


def upright_rotation(rotations: Float64[np.ndarray, "N 3 3"]) -> Float64[np.ndarray, "3 3"]:
    """Compute the rotation of the world that makes +z the common up direction of the cameras.

    Cameras that are held level have their x axes in the ground plane, so the up direction is perpendicular to
    all x axes. If the x axes do not span a plane, the mean of the up directions of the cameras is used.

    Args:
        rotations: rotations from world to camera, in OpenCV's convention.

    Returns:
        The rotation from the given to the upright world; the identity if the up directions cancel out.
    """
    right, up = rotations[:, 0], -rotations[:, 1].mean(axis=0)
    values, vectors = np.linalg.eigh(right.T @ right / len(right))
    planar = values[1] > MIN_EIGENVALUE_RATIO and values[0] < MIN_EIGENVALUE_RATIO * values[1]
    if planar and abs(vectors[:, 0] @ up) > MIN_AGREEMENT:
        up = vectors[:, 0] * np.sign(vectors[:, 0] @ up)
    if np.linalg.norm(up) < 1e-6:
        return np.eye(3)
    z = up / np.linalg.norm(up)
    x = np.eye(3)[np.argmin(np.abs(z))]
    x = x - (x @ z) * z
    x /= np.linalg.norm(x)
    return np.stack([x, np.cross(z, x), z])


def turn_upright(model: pycolmap.Reconstruction, orientations: Mapping[str, int]) -> None:
    """Rotate a model, in place, so that +z is up. Scale and origin do not change.

    Args:
        model: a model with placed images.
        orientations: EXIF orientation of each image, by its name in the model. It is needed because the
            stored image of a camera that was held on its side has a vertical x axis.
    """
    images = [model.image(i) for i in model.reg_image_ids()]
    turns = [TURNS.get(orientations[image.name], np.eye(3)) for image in images]
    rotations = np.stack(
        [q @ image.cam_from_world().rotation.matrix() for q, image in zip(turns, images, strict=True)]
    )
    turn = pycolmap.Rotation3d(upright_rotation(rotations))
    model.transform(pycolmap.Sim3d(1.0, turn, np.zeros(3)))
