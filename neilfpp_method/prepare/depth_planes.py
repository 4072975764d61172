"""Planes fitted to a depth map in windows: they smooth it, and their slopes give the normals.

In the image of a plane, inverse depth is an affine function of the pixel: 1/z = a u + b v + c with the
coordinates (u, v) = (x/z, y/z), and the normal of the plane is parallel to (a, b, c). A linear least-squares
fit of inverse depth in each window is therefore sufficient.
"""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from jaxtyping import Float32, Float64

from neilfpp_method.data.cameras.camera import Camera

__all__ = ["OrientedDepth", "fit_planes"]

WINDOW = 13
"""Side of the window of a plane, in pixels. Normals are derivatives of depth, which amplifies its noise, so
it is about twice as large as the correlation window of stereo."""

MIN_SHARE = 0.4
"""Smallest share of the pixels in a window whose depth is known. Windows at the outline of an object, of
which about half lies on it, are kept."""

MIN_FACING = 0.17
"""Smallest cosine between normal and viewing direction: the plane is seen at 10° or more. Depth on planes
that are seen at a smaller angle is inaccurate."""

MIN_DETERMINANT = 1e-3
"""Smallest determinant of the covariance of (u, v) in a window, relative to that of an evenly filled window
of this size. Below it, the known pixels lie on a line and do not determine a plane."""


@dataclass(frozen=True)
class OrientedDepth:
    """A depth map with normals.

    Attributes:
        depth: depth along the optical axis, world units, 0 if unknown.
        normal: unit normal in the world frame, towards the camera; 0 if the depth is unknown.
    """

    depth: Float32[np.ndarray, "H W"]
    normal: Float32[np.ndarray, "H W 3"]


def fit_planes(camera: Camera, depth: Float32[np.ndarray, "H W"], step: float) -> OrientedDepth:
    """Fit a plane to the known depths in the window around each pixel, by least squares of inverse depth.

    The result is unknown at pixels whose depth is unknown, if less than 40 % of the window is known, if the
    inverse depths deviate from the plane by more than `step` in the root mean square, as at depth edges, or
    if the plane is seen at less than 10°.

    Args:
        camera: a pinhole camera.
        depth: its depth map, 0 if unknown.
        step: the difference of inverse depth that the depth map can resolve.
    """
    known = depth > 0
    rows, columns = np.mgrid[: camera.height, : camera.width].astype(np.float64) + 0.5
    u, v = (columns - camera.cx) / camera.fx, (rows - camera.cy) / camera.fy
    q = np.divide(1.0, depth, out=np.zeros(depth.shape), where=known)
    weight = known.astype(np.float64)
    known_count = _window_sum(weight)
    share = known_count / WINDOW**2
    n = np.maximum(known_count, 1.0)
    mean_u, mean_v, mean_q = (_window_sum(weight * value) / n for value in (u, v, q))
    uu = _window_sum(weight * u * u) / n - mean_u * mean_u
    uv = _window_sum(weight * u * v) / n - mean_u * mean_v
    vv = _window_sum(weight * v * v) / n - mean_v * mean_v
    uq = _window_sum(weight * u * q) / n - mean_u * mean_q
    vq = _window_sum(weight * v * q) / n - mean_v * mean_q
    qq = _window_sum(weight * q * q) / n - mean_q * mean_q
    determinant = uu * vv - uv * uv
    # The standard deviation of a coordinate in a full window is about a quarter of its side.
    solvable = determinant > MIN_DETERMINANT * (WINDOW / 4 / camera.fx) ** 4
    safe = np.where(solvable, determinant, 1.0)
    a, b = (vv * uq - uv * vq) / safe, (uu * vq - uv * uq) / safe
    residual = np.sqrt(np.maximum(qq - a * uq - b * vq, 0.0))
    c = mean_q - a * mean_u - b * mean_v
    fitted = a * u + b * v + c
    # (a, b, c) · (x, y, z) = 1 on the plane in front of the camera, so −(a, b, c) points towards the camera.
    plane = -np.stack([a, b, c], axis=-1)
    normal = plane / np.maximum(np.linalg.norm(plane, axis=-1, keepdims=True), 1e-12)
    ray = np.stack([u, v, np.ones_like(u)], axis=-1)
    facing = -(normal * ray).sum(axis=-1) / np.linalg.norm(ray, axis=-1)
    good = (
        known & (share >= MIN_SHARE) & solvable & (residual <= step) & (fitted > 0) & (facing >= MIN_FACING)
    )
    smooth = np.where(good, 1.0 / np.where(good, fitted, 1.0), 0.0)
    world = normal @ camera.w2c[:3, :3]
    return OrientedDepth(smooth.astype(np.float32), np.where(good[..., None], world, 0.0).astype(np.float32))


def _window_sum(values: Float64[np.ndarray, "H W"]) -> Float64[np.ndarray, "H W"]:
    return cv2.boxFilter(values, -1, (WINDOW, WINDOW), normalize=False, borderType=cv2.BORDER_CONSTANT)
