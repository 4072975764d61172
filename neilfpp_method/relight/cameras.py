"""Cameras to render: the views of a capture in any size, or a circle of cameras around the scene."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
import torch
from jaxtyping import Bool, Float, Float64, Int
from torch import Tensor

from neilfpp_method.data.cameras.camera import Camera, scaled_camera
from neilfpp_method.data.capture import Capture
from neilfpp_method.data.views import View
from neilfpp_method.errors import UserError
from neilfpp_method.structures import RayBatch

__all__ = [
    "MAX_SIDE",
    "MAX_WIDTH",
    "ImageRays",
    "Shot",
    "pixel_rays",
    "rays_through",
    "resized",
    "turntable",
    "view_shots",
]

MAX_WIDTH = 800
"""Largest default width, pixels, because a path-traced image of the size of a photograph takes long."""
MAX_SIDE = 8192
"""Largest width and height, pixels. Larger images and the inputs of a denoiser do not fit into memory."""
MAX_FRAMES = 9999
"""Largest number of frames of a turntable, for which names have four digits."""
POLE_MARGIN = 2e-3
"""Least angle between a turntable camera and the vertical, radians, at which "up" is still well defined."""


@dataclass(frozen=True)
class Shot:
    """An image to render.

    Attributes:
        name: name of the image, valid as a file name.
        camera: the camera, scene frame.
        view: the view of the capture with the same camera and size; None if there is none.
    """

    name: str
    camera: Camera
    view: View | None = None


def view_shots(capture: Capture, views: Sequence[View], scale: float | None, width: int | None) -> list[Shot]:
    """Build shots of views of a capture.

    Args:
        capture: the capture.
        views: the views.
        scale: size relative to the views.
        width: width, pixels. If neither is given, views keep their size, up to a width of `MAX_WIDTH`.

    Raises:
        UserError: there are no views, or the size is impossible.
    """
    if not views:
        raise UserError(f"{capture.root}: no such views", "choose --views train or turntable")
    shots = []
    for view in views:
        camera = capture.scene_camera(view)
        shot_camera = resized(camera, _factor(camera, scale, width))
        same_size = (shot_camera.width, shot_camera.height) == (camera.width, camera.height)
        shots.append(Shot(view.name, shot_camera, view if same_size else None))
    return shots


def turntable(capture: Capture, frames: int, scale: float | None, width: int | None) -> list[Shot]:
    """Build shots from a circle around the scene's +z axis that look at its centre.

    Distance and elevation are the medians over the capture's cameras. Focal length and size are those of the
    view whose distance is nearest to the median, without lens distortion.

    Args:
        capture: the capture.
        frames: number of cameras.
        scale: size relative to the view.
        width: width, pixels. If neither is given, the size is that of the view, up to `MAX_WIDTH`.

    Raises:
        UserError: the number of frames is not within 2 … 9999, or the size is impossible.
    """
    if not 2 <= frames <= MAX_FRAMES:
        raise UserError(f"a turntable cannot have {frames} frames", f"give 2 to {MAX_FRAMES} with --frames")
    cameras = [capture.scene_camera(view) for view in capture.views]
    eyes = np.stack([camera.c2w[:, 3] for camera in cameras])
    distances = np.linalg.norm(eyes, axis=-1).clip(1e-6)
    distance = float(np.median(distances))
    elevation = float(np.median(np.arcsin((eyes[:, 2] / distances).clip(-1, 1))))
    # Seen from exactly above, "up" is undefined.
    elevation = float(np.clip(elevation, -math.pi / 2 + POLE_MARGIN, math.pi / 2 - POLE_MARGIN))
    camera = cameras[int(np.abs(distances - distance).argmin())]
    camera = replace(camera, lens=None, cx=camera.width / 2, cy=camera.height / 2)
    camera = resized(camera, _factor(camera, scale, width))
    azimuths = 2 * math.pi * np.arange(frames) / frames
    return [
        Shot(f"turn_{k:04d}", replace(camera, w2c=_looking_at_origin(distance, elevation, azimuth)))
        for k, azimuth in enumerate(azimuths)
    ]


def resized(camera: Camera, factor: float) -> Camera:
    """`scaled_camera` with the size multiplied by a factor.

    Raises:
        UserError: width or height is not within 1 … 8192 pixels.
    """
    width, height = round(camera.width * factor), round(camera.height * factor)
    if not (1 <= width <= MAX_SIDE and 1 <= height <= MAX_SIDE):
        raise UserError(
            f"an image cannot have {width}×{height} pixels",
            f"choose --scale or --width for 1 to {MAX_SIDE} pixels per side",
        )
    return scaled_camera(camera, width, height)


@dataclass(frozen=True)
class ImageRays:
    """Rays through points of an image, in the frame of the camera's pose.

    Attributes:
        rays: the rays.
        valid: whether the lens shows anything at the point.
    """

    rays: RayBatch
    valid: Bool[Tensor, " N"]


def rays_through(camera: Camera, points: Float[Tensor, "N 2"]) -> ImageRays:
    """Build rays through points of the image of a camera.

    Args:
        camera: the camera.
        points: image points (x, y), pixels; the centre of a pixel is at column + ½, row + ½.
    """
    plane = (points.double().cpu().numpy() - camera.intrinsics[2:]) / camera.intrinsics[:2]
    if camera.lens is not None:
        plane = camera.lens.straighten(plane)
    valid = np.isfinite(plane).all(axis=1)
    local = np.concatenate([np.where(valid[:, None], plane, 0.0), np.ones((len(plane), 1))], axis=1)
    pose = camera.c2w
    directions = (local / np.linalg.norm(local, axis=1, keepdims=True)) @ pose[:, :3].T
    origins = np.broadcast_to(pose[:, 3], directions.shape)
    rays = RayBatch(
        *(torch.from_numpy(part.astype(np.float32)).to(points.device) for part in (origins, directions))
    )
    return ImageRays(rays, torch.from_numpy(valid).to(points.device))


def pixel_rays(
    camera: Camera, pixel: Int[Tensor, " N"], within: float | Float[Tensor, "*N 2"] = 0.5
) -> ImageRays:
    """Build a ray through each pixel, given by its row-major index, at a position in [0, 1]² of the pixel."""
    corner = torch.stack((pixel % camera.width, pixel // camera.width), -1)
    return rays_through(camera, corner + within)


def _factor(camera: Camera, scale: float | None, width: int | None) -> float:
    if width is not None:
        return width / camera.width
    if scale is not None:
        return scale
    return min(1.0, MAX_WIDTH / camera.width)


def _looking_at_origin(distance: float, elevation: float, azimuth: float) -> Float64[np.ndarray, "4 4"]:
    """World-to-camera matrix of an upright camera on a sphere around the origin that looks at the origin."""
    outward = np.array(
        [
            math.cos(azimuth) * math.cos(elevation),
            math.sin(azimuth) * math.cos(elevation),
            math.sin(elevation),
        ]
    )
    right = np.array([-math.sin(azimuth), math.cos(azimuth), 0.0])
    rotation = np.stack([right, np.cross(-outward, right), -outward])
    pose = np.eye(4)
    pose[:3, :3] = rotation
    pose[:3, 3] = -rotation @ (distance * outward)
    return pose
