"""Depth maps without CUDA: each view is compared with its neighbours, warped over planes in front of it.

OpenCV does the warping and the windows' sums.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import cv2
import numpy as np
import torch
from jaxtyping import Bool, Float32, Float64

from neilfpp_method.data.images import read_image
from neilfpp_method.data.undistort import resample, straight_camera
from neilfpp_method.data.views import Camera, Normalisation, View
from neilfpp_method.shading.color import luminance

__all__ = ["GreyView", "choose_sources", "grain", "grey_view", "sweep"]

MAX_SIDE = 640
WINDOW = 7
MAX_ANGLE, BEST_ANGLE, MIN_ANGLE = 35.0, 12.0, 3.0
MIN_PLANES, MAX_PLANES = 32, 224
MIN_SCORE = 0.6
FLAT = 1e-5
"""Variance below which a window shows nothing; grey values run from 0 to 1."""
ROOM = 1.15
MIN_DEPTH = 0.05


@dataclass(frozen=True)
class GreyView:
    """A view as it is compared: a pinhole, small enough for a dense search, with grey values in [0, 1]."""

    camera: Camera
    grey: Float32[np.ndarray, "H W"]


def grey_view(view: View, linear: bool) -> GreyView:
    """Read a view, undo its lens and scale it down where it has more than 640 pixels a side.

    The square root of luminance evens out the noise of dark and bright pixels. Correlation does not see
    brightness and contrast, so exposures need no care.
    """
    image = read_image(view.image).pixels
    usable = np.where(np.isfinite(image) & (image > 0), image, np.float32(0))
    color = np.broadcast_to(usable, (*image.shape[:2], 3)).copy()
    camera = straight_camera(view.camera)
    if camera is not view.camera:
        color = resample(color, view.camera, camera)
    grey = luminance(torch.from_numpy(color)).numpy()
    grey = np.sqrt(grey / max(float(np.quantile(grey, 0.99)), 1e-9)).clip(0.0, 1.0) if linear else grey
    share = min(1.0, MAX_SIDE / max(camera.width, camera.height))
    width, height = round(camera.width * share), round(camera.height * share)
    if (width, height) != (camera.width, camera.height):
        grey = cv2.resize(grey, (width, height), interpolation=cv2.INTER_AREA)
        across, down = width / camera.width, height / camera.height
        scaled = {
            "fx": camera.fx * across,
            "cx": camera.cx * across,
            "fy": camera.fy * down,
            "cy": camera.cy * down,
        }
        camera = replace(camera, **scaled, width=width, height=height)
    return GreyView(camera, np.ascontiguousarray(grey, np.float32))


def choose_sources(
    cameras: Sequence[Camera], centre: Float64[np.ndarray, " 3"], count: int
) -> list[list[int]]:
    """For each camera at most `count` others to compare with: those at the best angles to it.

    Wider angles tell depth better, narrower ones show the same picture. A camera may have none.
    """
    eyes = np.stack([camera.c2w[:, 3] for camera in cameras])
    directions = (eyes - centre) / np.linalg.norm(eyes - centre, axis=1, keepdims=True)
    angles = np.degrees(np.arccos(np.clip(directions @ directions.T, -1.0, 1.0)))
    fit = np.abs(np.log(np.maximum(angles, 1e-3) / BEST_ANGLE))
    fit[(angles < MIN_ANGLE) | (angles > MAX_ANGLE)] = np.inf
    order = np.argsort(fit, axis=1)[:, :count]
    return [[int(j) for j in row if np.isfinite(fit[i, j])] for i, row in enumerate(order)]


def grain(camera: Camera, sources: Sequence[Camera]) -> float:
    """The step of inverse depth that moves the farthest source's picture by a pixel; 0 without sources."""
    return (
        1.0 / (camera.fx * max(float(np.linalg.norm(s.c2w[:, 3] - camera.c2w[:, 3])) for s in sources))
        if sources
        else 0.0
    )


def sweep(reference: GreyView, sources: Sequence[GreyView], box: Normalisation) -> Float32[np.ndarray, "H W"]:
    """The depth of each pixel along the camera's axis, world units; 0 where it is not known.

    Planes across the axis, evenly spaced in inverse depth, lie through the scene's sphere so that neighbours
    move the picture by a pixel. Each source, warped over a plane, is correlated with the reference in
    windows; the two best sources count, as others may be hidden. The plane of the highest mean correlation
    wins, refined by a parabola. Without sources nothing is known.
    """
    if not sources:
        return np.zeros_like(reference.grey)
    inverse = _planes(reference, sources, box)
    ours = _Windows(reference.grey)
    volume = np.stack([_score(reference, sources, ours, float(value)) for value in inverse])
    best = volume.argmax(axis=0)
    inner = np.clip(best, 1, len(inverse) - 2)
    below, peak, above = (np.take_along_axis(volume, inner[None] + step, axis=0)[0] for step in (-1, 0, 1))
    curve = below - 2 * peak + above
    offset = np.where(curve < -1e-6, (below - above) / (2 * np.minimum(curve, -1e-6)), 0.0).clip(-0.5, 0.5)
    refined = inverse[0] + (inner + offset) * (inverse[1] - inverse[0])
    known = (best == inner) & (peak >= MIN_SCORE) & ours.textured
    return np.where(known, 1.0 / refined, 0.0).astype(np.float32)


class _Windows:
    """Means and variances of a picture in windows."""

    def __init__(self, grey: Float32[np.ndarray, "H W"]) -> None:
        self.grey = grey
        self.mean = _box(grey)
        self.variance = np.maximum(_box(grey * grey) - self.mean**2, 0.0)

    @property
    def textured(self) -> Bool[np.ndarray, "H W"]:
        return self.variance > FLAT


def _planes(
    reference: GreyView, sources: Sequence[GreyView], box: Normalisation
) -> Float64[np.ndarray, " D"]:
    camera = reference.camera
    middle = float(camera.w2c[2, :3] @ np.array(box.centre) + camera.w2c[2, 3])
    far = middle + ROOM * box.scale
    near = max(middle - ROOM * box.scale, MIN_DEPTH * far)
    count = int((1 / near - 1 / far) / grain(camera, [source.camera for source in sources]))
    return np.linspace(1 / far, 1 / near, min(max(count, MIN_PLANES), MAX_PLANES))


def _score(
    reference: GreyView, sources: Sequence[GreyView], ours: _Windows, inverse_depth: float
) -> Float32[np.ndarray, "H W"]:
    """The mean of the two highest correlations with the sources warped over a plane."""
    first = np.full(ours.grey.shape, -1.0, np.float32)
    second = first.copy()
    for source in sources:
        correlation = _correlation(ours, _Windows(_warped(reference.camera, source, inverse_depth)))
        second = np.maximum(second, np.minimum(first, correlation))
        first = np.maximum(first, correlation)
    return 0.5 * (first + second) if len(sources) > 1 else first


def _warped(camera: Camera, source: GreyView, inverse_depth: float) -> Float32[np.ndarray, "H W"]:
    """What the camera would see of the source's picture, were it painted on the plane."""
    motion = source.camera.w2c @ np.linalg.inv(camera.w2c)
    plane = motion[:3, :3] + np.outer(motion[:3, 3], [0.0, 0.0, inverse_depth])
    homography = _pixels(source.camera) @ plane @ np.linalg.inv(_pixels(camera))
    size = (camera.width, camera.height)
    return cv2.warpPerspective(source.grey, homography, size, flags=cv2.INTER_LINEAR | cv2.WARP_INVERSE_MAP)


def _pixels(camera: Camera) -> Float64[np.ndarray, "3 3"]:
    """The camera's matrix for OpenCV, which counts from the centre of the first pixel."""
    return np.array([[camera.fx, 0, camera.cx - 0.5], [0, camera.fy, camera.cy - 0.5], [0, 0, 1.0]])


def _correlation(a: _Windows, b: _Windows) -> Float32[np.ndarray, "H W"]:
    together = _box(a.grey * b.grey) - a.mean * b.mean
    return together / np.sqrt(np.maximum(a.variance * b.variance, FLAT**2))


def _box(values: Float32[np.ndarray, "H W"]) -> Float32[np.ndarray, "H W"]:
    return cv2.boxFilter(values, -1, (WINDOW, WINDOW), borderType=cv2.BORDER_REFLECT)
