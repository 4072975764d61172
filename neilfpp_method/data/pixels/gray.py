"""Views as stereo compares them: grey, small, without lens distortion."""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
import torch
from jaxtyping import Float32

from neilfpp_method.data.cameras.camera import Camera, scaled_camera
from neilfpp_method.data.cameras.undistort import resample, straight_camera
from neilfpp_method.shading.color import luminance

__all__ = ["GrayView", "gray_of"]

MAX_SIDE = 640
"""Longest side of the compared images, in pixels; a larger image is scaled down. Time and memory of
stereo grow with the third power of it, because the number of planes grows as well."""


@dataclass(frozen=True)
class GrayView:
    """The image of a view as stereo compares it.

    Attributes:
        camera: a pinhole of at most `MAX_SIDE` pixels a side.
        gray: grey values in [0, 1], of the camera's size.
    """

    camera: Camera
    gray: Float32[np.ndarray, "H W"]


def gray_of(color: Float32[np.ndarray, "H W 3"], camera: Camera, linear: bool) -> GrayView:
    """The grey view of an image: without lens distortion, at most `MAX_SIDE` pixels a side.

    Exposure and white balance are not corrected, because the correlation of two windows does not depend on
    brightness and contrast.

    Args:
        color: finite colours, not negative.
        camera: the camera of the image.
        linear: whether colours are linear radiance. If so, the square root of luminance is used, which makes
            the noise of dark and bright pixels similar.
    """
    straight = straight_camera(camera)
    if straight is not camera:
        color = resample(color, camera, straight)
    gray = luminance(torch.from_numpy(color)).numpy()
    gray = np.sqrt(gray / max(float(np.quantile(gray, 0.99)), 1e-9)).clip(0.0, 1.0) if linear else gray
    scale = min(1.0, MAX_SIDE / max(straight.width, straight.height))
    width, height = round(straight.width * scale), round(straight.height * scale)
    if (width, height) != (straight.width, straight.height):
        gray = cv2.resize(gray, (width, height), interpolation=cv2.INTER_AREA)
        straight = scaled_camera(straight, width, height)
    return GrayView(straight, np.ascontiguousarray(gray, np.float32))
