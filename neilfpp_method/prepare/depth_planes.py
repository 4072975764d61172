"""Local planes through a depth map: they smooth it, and their slopes are its normals.

In the picture of a plane, inverse depth is an affine function of the pixel: 1/z = a u + b v + c in the
coordinates (u, v) = (x/z, y/z), and the plane's normal is along (a, b, c). So a line fit in windows is all it
takes.
"""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from jaxtyping import Float32, Float64

from neilfpp_method.data.views import Camera

__all__ = ["OrientedDepth", "fit_planes"]

WINDOW = 13
MIN_SHARE = 0.4
MIN_FACING = 0.17


@dataclass(frozen=True)
class OrientedDepth:
    """Depth along the camera's axis, 0 where unknown, and unit world normals towards the camera."""

    depth: Float32[np.ndarray, "H W"]
    normal: Float32[np.ndarray, "H W 3"]


def fit_planes(camera: Camera, depth: Float32[np.ndarray, "H W"], grain: float) -> OrientedDepth:
    """The depth of the plane that fits the known depths of a window best, and its normal.

    Unknown where less than 40 % of the window is known, where inverse depths scatter about the plane by more
    than `grain`, at an edge of the object that is, or where the plane is seen at less than 10°.

    Args:
        camera: a pinhole.
        depth: its depth map, 0 where not known.
        grain: the difference of inverse depth that moves the picture in another view by a pixel.
    """
    known = depth > 0
    rows, columns = np.mgrid[: camera.height, : camera.width].astype(np.float64) + 0.5
    u, v = (columns - camera.cx) / camera.fx, (rows - camera.cy) / camera.fy
    q = np.divide(1.0, depth, out=np.zeros(depth.shape), where=known)
    weight = known.astype(np.float64)
    n = _sum(weight)
    share = n / WINDOW**2
    n = np.maximum(n, 1.0)
    means = {name: _sum(weight * value) / n for name, value in (("u", u), ("v", v), ("q", q))}

    def covariance(
        a: Float64[np.ndarray, "H W"], b: Float64[np.ndarray, "H W"], of: str
    ) -> Float64[np.ndarray, "H W"]:
        return _sum(weight * a * b) / n - means[of[0]] * means[of[1]]

    uu, uv, vv = covariance(u, u, "uu"), covariance(u, v, "uv"), covariance(v, v, "vv")
    uq, vq, qq = covariance(u, q, "uq"), covariance(v, q, "vq"), covariance(q, q, "qq")
    determinant = uu * vv - uv * uv
    solvable = determinant > 1e-3 * (WINDOW / 4 / camera.fx) ** 4
    safe = np.where(solvable, determinant, 1.0)
    a, b = (vv * uq - uv * vq) / safe, (uu * vq - uv * uq) / safe
    residual = np.sqrt(np.maximum(qq - a * uq - b * vq, 0.0))
    c = means["q"] - a * means["u"] - b * means["v"]
    fitted = a * u + b * v + c
    plane = -np.stack(
        [a, b, c], axis=-1
    )  # (a, b, c) · (x, y, z) = 1 in front of the camera: the normal looks back
    normal = plane / np.maximum(np.linalg.norm(plane, axis=-1, keepdims=True), 1e-12)
    ray = np.stack([u, v, np.ones_like(u)], axis=-1)
    facing = -(normal * ray).sum(axis=-1) / np.linalg.norm(ray, axis=-1)
    good = (
        known & (share >= MIN_SHARE) & solvable & (residual <= grain) & (fitted > 0) & (facing >= MIN_FACING)
    )
    smooth = np.where(good, 1.0 / np.where(good, fitted, 1.0), 0.0)
    world = normal @ camera.w2c[:3, :3]
    return OrientedDepth(smooth.astype(np.float32), np.where(good[..., None], world, 0.0).astype(np.float32))


def _sum(values: Float64[np.ndarray, "H W"]) -> Float64[np.ndarray, "H W"]:
    return cv2.boxFilter(values, -1, (WINDOW, WINDOW), normalize=False, borderType=cv2.BORDER_CONSTANT)
