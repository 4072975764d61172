"""Scale views to another size than that of their files: cameras, and pixels averaged over their area.

A pixel of a smaller image is the mean over its area of the linear radiance of the pixels that it covers
(display values are linearised, averaged, and encoded again). An image point (u, v) of the file is then at (u
· w/W, v · h/H), as pixel centres are at +0.5: focal lengths and principal points are multiplied by the same
factors, and a lens keeps its coefficients, which apply to the plane at unit distance.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace

import cv2
import numpy as np
from jaxtyping import Bool, Float32, Shaped

from neilfpp_method.data.cameras.camera import scaled_camera
from neilfpp_method.data.capture import Capture
from neilfpp_method.data.views import View
from neilfpp_method.errors import UserError

__all__ = [
    "PIXELS_OF_A_VIEW",
    "area_average",
    "area_share",
    "at_scale",
    "file_size",
    "nearest",
    "scale_for_pixels",
    "scale_for_rays",
    "scale_for_width",
    "scaled_view",
]

PIXELS_OF_A_VIEW = 2**17
"""Default number of pixels of a view for rendering and measuring: about 420 × 310."""
PIXELS_OF_A_RAY = 4
"""Number of training pixels per ray of the whole training. Of a larger number most would never be drawn; a
smaller image has their means, with less noise."""
MIN_REDUCING_SCALE = 0.98
"""Smallest scale that is rounded to 1, because so small a reduction is not worth resampling."""


def file_size(view: View) -> tuple[int, int]:
    """Return width and height of the files of a view, in pixels."""
    return view.file_size or (view.camera.width, view.camera.height)


def scaled_view(view: View, scale: float) -> View:
    """Return the view at `scale` times the size of its files.

    Raises:
        UserError: the scale is not above 0 and at most 1.
    """
    if not 0.0 < scale <= 1.0:
        raise UserError(f"images cannot be scaled by {scale:g}", "give a factor above 0 and at most 1")
    width, height = file_size(view)
    size = (max(1, round(width * scale)), max(1, round(height * scale)))
    if size == (view.camera.width, view.camera.height):
        return view
    return replace(
        view,
        camera=scaled_camera(view.camera, *size),
        file_size=None if size == (width, height) else (width, height),
    )


def at_scale(capture: Capture, scale: float) -> Capture:
    """Return the capture with all views at `scale` times the size of their files."""
    return replace(capture, views=tuple(scaled_view(view, scale) for view in capture.views))


# ------------------------------------------------------------------------------------------------ which scale


def scale_for_rays(views: Sequence[View], rays: int) -> float:
    """Return the largest scale at which a training with this number of rays uses most pixels of the views.

    It leaves `PIXELS_OF_A_RAY` pixels per ray, and at least `PIXELS_OF_A_VIEW` pixels per view, so that
    captures of many views do not get tiny images.
    """
    return scale_for_pixels(views, max(PIXELS_OF_A_RAY * rays, PIXELS_OF_A_VIEW * len(views)))


def scale_for_pixels(views: Sequence[View], pixels: int) -> float:
    """Return the largest scale at which all views together have at most `pixels` pixels."""
    total = sum(math.prod(file_size(view)) for view in views)
    scale = math.sqrt(pixels / max(total, 1))
    return 1.0 if scale >= MIN_REDUCING_SCALE else round(scale, 4)


def scale_for_width(views: Sequence[View], width: int) -> float:
    """Return the scale at which the widest view has this width in pixels; 1 if no view is as wide.

    Raises:
        UserError: the width is not positive.
    """
    if width < 1:
        raise UserError(f"images cannot be {width} pixels wide", "give a width of 1 or more")
    return min(1.0, width / max(file_size(view)[0] for view in views))


# ------------------------------------------------------------------------------------------------- resampling


def area_average(
    values: Float32[np.ndarray, "H W *C"], width: int, height: int
) -> Float32[np.ndarray, "h w *C"]:
    """Return area means at a smaller size, with weights for partially covered pixels."""
    if values.shape[:2] == (height, width):
        return values
    averaged = cv2.resize(np.ascontiguousarray(values), (width, height), interpolation=cv2.INTER_AREA)
    return averaged.reshape(height, width, *values.shape[2:])


def area_share(marked: Bool[np.ndarray, "H W"], width: int, height: int) -> Float32[np.ndarray, "h w"]:
    """Return the share of the area of each pixel that is marked."""
    return area_average(marked.astype(np.float32), width, height)


def nearest(values: Shaped[np.ndarray, "H W *C"], width: int, height: int) -> Shaped[np.ndarray, "h w *C"]:
    """Return the nearest values at a smaller size, for values that must not be averaged, such as depths."""
    rows = ((np.arange(height) + 0.5) * values.shape[0] / height).astype(np.int64)
    columns = ((np.arange(width) + 0.5) * values.shape[1] / width).astype(np.int64)
    return values[rows[:, None], columns]
