"""Plane-sweep stereo on the CPU: one depth map per view, from the comparison with a few source views.

For each plane of a stack of planes parallel to the image plane of the reference view, the source views are
warped onto the reference view as if the scene lay on that plane. The plane at which warped and reference
image correlate best in the window around a pixel gives the depth of that pixel (Collins, A Space-Sweep
Approach to True Multi-Image Matching, CVPR 1996). OpenCV does the warping and the sums over windows.
"""

from __future__ import annotations

from collections.abc import Sequence

import cv2
import numpy as np
from jaxtyping import Bool, Float32, Float64

from neilfpp_method.data.cameras.camera import Camera
from neilfpp_method.data.files.images import read_image
from neilfpp_method.data.pixels.gray import GrayView, gray_of
from neilfpp_method.data.views import Normalization, View

__all__ = ["gray_view", "inverse_depth_step", "sweep"]

WINDOW = 7
"""Side of the square correlation window, in pixels. A larger window is less sensitive to noise, but it blurs
depth at the edges of objects."""

MIN_PLANES = 32
"""Smallest number of planes, so that the parabola through three neighbouring scores is meaningful even if the
cameras stand close together."""

MAX_PLANES = 224
"""Largest number of planes. It bounds the memory of the scores: for 640 × 480 pixels they take 275 MB."""

MIN_SCORE = 0.6
"""Smallest normalised cross-correlation, at most 1, with which a depth is kept."""

MIN_VARIANCE = 1e-5
"""Smallest variance of a textured window, for grey values in [0, 1]: a standard deviation of 0.8 levels of an
8-bit image, about its quantisation noise."""

MARGIN = 1.15
"""Half the depth range of the planes, in radii of the scene's sphere: a margin of 15 %, as the sphere of a
capture is an estimate."""

MIN_DEPTH_RATIO = 0.05
"""Smallest depth of the nearest plane, as a share of the depth of the farthest one. It applies to cameras
inside or close to the scene's sphere, for which the range would otherwise begin at or behind the camera."""


def gray_view(view: View, linear: bool) -> GrayView:
    """Read the image of a view for stereo: grey, without lens distortion, at most `MAX_SIDE` pixels a side.

    Args:
        view: a view of a capture.
        linear: whether pixels are linear radiance.
    """
    image = read_image(view.image).pixels
    usable = np.where(np.isfinite(image) & (image > 0), image, np.float32(0))
    color = np.broadcast_to(usable, (*image.shape[:2], 3)).copy()
    return gray_of(color, view.camera, linear)


def inverse_depth_step(camera: Camera, sources: Sequence[Camera]) -> float:
    """The change of inverse depth that moves a pixel by one pixel in the source with the longest baseline.

    This is the resolution of a depth map by stereo: 1 / (focal length in pixels · baseline), in one over
    world units. It is 0 without sources.
    """
    if not sources:
        return 0.0
    eye = camera.c2w[:, 3]
    baseline = max(float(np.linalg.norm(source.c2w[:, 3] - eye)) for source in sources)
    return 1.0 / (camera.fx * baseline)


def sweep(reference: GrayView, sources: Sequence[GrayView], box: Normalization) -> Float32[np.ndarray, "H W"]:
    """Compute the depth map of a view by plane-sweep stereo.

    The planes are evenly spaced in inverse depth, cover the scene's sphere, and are at most one pixel of
    disparity apart unless that takes more than `MAX_PLANES`. The score of a plane is the normalised
    cross-correlation of windows, averaged over the two best sources, because the surface may be hidden in the
    others. The depth with the highest score is refined by a parabola through it and its two neighbours.

    Args:
        reference: the view whose depth is computed.
        sources: the views that it is compared with. Without any, no depth is known.
        box: centre and radius of the scene's sphere, in the world frame.

    Returns:
        Depth along the optical axis in world units; 0 if it is unknown: in windows without texture, with a
        score below `MIN_SCORE`, with the best score at the first or the last plane, or everywhere if the
        scene's sphere is behind the camera.
    """
    if not sources:
        return np.zeros_like(reference.gray)
    inverse_depths = _planes(reference, sources, box)
    if not len(inverse_depths):
        return np.zeros_like(reference.gray)
    windows = _Windows(reference.gray)
    scores = np.stack([_score(reference, sources, windows, float(value)) for value in inverse_depths])
    best = scores.argmax(axis=0)
    inner = np.clip(best, 1, len(inverse_depths) - 2)
    below, peak, above = (np.take_along_axis(scores, inner[None] + step, axis=0)[0] for step in (-1, 0, 1))
    curvature = below - 2 * peak + above
    peaked = curvature < -1e-6
    offset = np.where(peaked, (below - above) / (2 * np.where(peaked, curvature, -1.0)), 0.0).clip(-0.5, 0.5)
    refined = inverse_depths[0] + (inner + offset) * (inverse_depths[1] - inverse_depths[0])
    known = (best == inner) & (peak >= MIN_SCORE) & windows.textured
    return np.where(known, 1.0 / refined, 0.0).astype(np.float32)


class _Windows:
    """Means and variances of an image in the window around each pixel."""

    def __init__(self, gray: Float32[np.ndarray, "H W"]) -> None:
        self.gray = gray
        self.mean = _window_mean(gray)
        self.variance = np.maximum(_window_mean(gray * gray) - self.mean**2, 0.0)

    @property
    def textured(self) -> Bool[np.ndarray, "H W"]:
        return self.variance > MIN_VARIANCE


def _planes(
    reference: GrayView, sources: Sequence[GrayView], box: Normalization
) -> Float64[np.ndarray, " D"]:
    """The inverse depths of the planes, from the farthest to the nearest; none behind the camera."""
    camera = reference.camera
    center_depth = float(camera.w2c[2, :3] @ np.array(box.center) + camera.w2c[2, 3])
    far = center_depth + MARGIN * box.scale
    if far <= 0:
        return np.zeros(0)
    near = max(center_depth - MARGIN * box.scale, MIN_DEPTH_RATIO * far)
    step = inverse_depth_step(camera, [source.camera for source in sources])
    count = int((1 / near - 1 / far) / step)
    return np.linspace(1 / far, 1 / near, min(max(count, MIN_PLANES), MAX_PLANES))


def _score(
    reference: GrayView, sources: Sequence[GrayView], windows: _Windows, inverse_depth: float
) -> Float32[np.ndarray, "H W"]:
    """The mean of the two highest correlations of the reference with its sources warped over a plane."""
    first = np.full(windows.gray.shape, -1.0, np.float32)
    second = first.copy()
    for source in sources:
        correlation = _correlation(windows, _Windows(_warp(reference.camera, source, inverse_depth)))
        second = np.maximum(second, np.minimum(first, correlation))
        first = np.maximum(first, correlation)
    return 0.5 * (first + second) if len(sources) > 1 else first


def _warp(camera: Camera, source: GrayView, inverse_depth: float) -> Float32[np.ndarray, "H W"]:
    """Warp the image of a source into a camera by the homography of the plane z = 1 / `inverse_depth`."""
    motion = source.camera.w2c @ np.linalg.inv(camera.w2c)
    plane = motion[:3, :3] + np.outer(motion[:3, 3], [0.0, 0.0, inverse_depth])
    homography = _opencv_matrix(source.camera) @ plane @ np.linalg.inv(_opencv_matrix(camera))
    size = (camera.width, camera.height)
    return cv2.warpPerspective(source.gray, homography, size, flags=cv2.INTER_LINEAR | cv2.WARP_INVERSE_MAP)


def _opencv_matrix(camera: Camera) -> Float64[np.ndarray, "3 3"]:
    """The intrinsic matrix in OpenCV's convention, in which the centre of the first pixel is (0, 0)."""
    return np.array([[camera.fx, 0, camera.cx - 0.5], [0, camera.fy, camera.cy - 0.5], [0, 0, 1.0]])


def _correlation(a: _Windows, b: _Windows) -> Float32[np.ndarray, "H W"]:
    """The normalised cross-correlation of two images in each window."""
    covariance = _window_mean(a.gray * b.gray) - a.mean * b.mean
    return covariance / np.sqrt(np.maximum(a.variance * b.variance, MIN_VARIANCE**2))


def _window_mean(values: Float32[np.ndarray, "H W"]) -> Float32[np.ndarray, "H W"]:
    return cv2.boxFilter(values, -1, (WINDOW, WINDOW), borderType=cv2.BORDER_REFLECT)
