"""Resample images to pinhole cameras, for layouts without lens distortion. Training does not need it."""

from __future__ import annotations

from dataclasses import replace

import cv2
import numpy as np
from jaxtyping import Float32

from neilfpp_method.data.cameras.camera import Camera
from neilfpp_method.data.cameras.colmap_library import pycolmap

__all__ = ["resample", "straight_camera"]


def straight_camera(camera: Camera) -> Camera:
    """Return the pinhole of the same pose that covers as much as possible of the image of a camera.

    A pinhole is returned unchanged.
    """
    if camera.lens is None:
        return camera
    bent = camera.lens.camera((camera.fx, camera.fy), (camera.cx, camera.cy), (camera.width, camera.height))
    pinhole = pycolmap.undistort_camera(pycolmap.UndistortCameraOptions(), bent)
    fx, fy, cx, cy = map(float, pinhole.params)
    return replace(camera, fx=fx, fy=fy, cx=cx, cy=cy, width=pinhole.width, height=pinhole.height, lens=None)


def resample(
    values: Float32[np.ndarray, "H W C"], camera: Camera, straight: Camera
) -> Float32[np.ndarray, "h w C"]:
    """Resample an image to a pinhole camera, bilinearly, with replicated borders."""
    rows, columns = np.mgrid[: straight.height, : straight.width].reshape(2, -1) + 0.5
    plane = (np.stack([columns, rows], axis=1) - straight.intrinsics[2:]) / straight.intrinsics[:2]
    pixel = camera.lens.bend(plane) * camera.intrinsics[:2] + camera.intrinsics[2:]
    # In OpenCV the centre of the first pixel is (0, 0).
    where = (pixel - 0.5).astype(np.float32).reshape(straight.height, straight.width, 2)
    moved = cv2.remap(values, where, None, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
    return moved.reshape(straight.height, straight.width, values.shape[2])
