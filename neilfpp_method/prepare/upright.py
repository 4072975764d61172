"""The world's up: COLMAP's frame has none, and light from a sky is described about +z."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
from jaxtyping import Float64

from neilfpp_method.data.colmap_library import pycolmap

__all__ = ["turn_upright", "upright_rotation"]

LEVEL = 0.1
HELD = {
    3: np.diag([-1.0, -1.0, 1.0]),
    6: np.array([[0.0, -1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, 1.0]]),
    8: np.array([[0.0, 1.0, 0.0], [-1.0, 0.0, 0.0], [0.0, 0.0, 1.0]]),
}
"""By EXIF's orientation, for cameras not held level: from camera axes to the picture's axes."""


def upright_rotation(rotations: Float64[np.ndarray, "N 3 3"]) -> Float64[np.ndarray, "3 3"]:
    """The rotation of the world after which the cameras, taken together, stand upright about +z.

    Cameras that are held level have their x axes in the ground plane, so up is the direction across all x
    axes. Where these do not span a plane, the mean of the cameras' own up directions has to do.

    Args:
        rotations: world to camera.
    """
    right, up = rotations[:, 0], -rotations[:, 1].mean(axis=0)
    values, vectors = np.linalg.eigh(right.T @ right / len(right))
    if values[1] > LEVEL and values[0] < LEVEL * values[1] and abs(vectors[:, 0] @ up) > LEVEL:
        up = vectors[:, 0] * np.sign(vectors[:, 0] @ up)
    if np.linalg.norm(up) < 1e-6:
        return np.eye(3)
    z = up / np.linalg.norm(up)
    x = np.eye(3)[np.argmin(np.abs(z))]
    x = x - (x @ z) * z
    x /= np.linalg.norm(x)
    return np.stack([x, np.cross(z, x), z])


def turn_upright(model: pycolmap.Reconstruction, held: Mapping[str, int]) -> None:
    """Turn a model, in place, so that +z is up; its scale and origin stay.

    Args:
        model: with placed images.
        held: EXIF's orientation of each image, by its name in the model: a camera on its side has its x axis
            upright.
    """
    images = [model.image(i) for i in model.reg_image_ids()]
    turns = [HELD.get(held[image.name], np.eye(3)) for image in images]
    rotations = np.stack(
        [q @ image.cam_from_world().rotation.matrix() for q, image in zip(turns, images, strict=True)]
    )
    turn = pycolmap.Rotation3d(upright_rotation(rotations))
    model.transform(pycolmap.Sim3d(1.0, turn, np.zeros(3)))
