"""What is looked at: the views of a capture in any size, or a circle of cameras about the scene."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
import torch
from jaxtyping import Bool, Float, Float64
from torch import Tensor

from neilfpp_method.data.capture import Capture
from neilfpp_method.data.views import Camera, View
from neilfpp_method.errors import UserError
from neilfpp_method.structures import RayBatch

__all__ = ["MAX_WIDTH", "Shot", "chosen_views", "rays_through", "resized", "turntable", "view_shots"]

MAX_WIDTH = 800
"""Pixels: photographs are larger than anybody wants to wait for, so this is where the default size ends."""
MAX_SIDE = 8192
"""Pixels of a picture's side: larger ones do not fit into memory together with what a denoiser needs."""


@dataclass(frozen=True)
class Shot:
    """A picture to take: its name, which is a plain file name, the camera in the scene frame, and the
    capture's view that it shows, if it shows one in full size."""

    name: str
    camera: Camera
    view: View | None = None


def chosen_views(capture: Capture, words: Sequence[str]) -> list[View]:
    """The views that are named, in the capture's order; "test", "train" and "all" are sets of views.

    Raises:
        UserError: a word is neither a set nor the name of a view.
    """
    sets = {"test": capture.test_views, "train": capture.train_views, "all": capture.views}
    by_name = {view.name: (view,) for view in capture.views}
    for word in words:
        if word not in sets and word not in by_name:
            example = f"name views as {capture.views[0].name}, or give {', '.join(sets)} or turntable"
            raise UserError(f"--views {word}: the capture has no view of this name", example)
    chosen = {view.name for word in words for view in (sets.get(word) or by_name.get(word, ()))}
    return [view for view in capture.views if view.name in chosen]


def view_shots(capture: Capture, views: Sequence[View], scale: float | None, width: int | None) -> list[Shot]:
    """Views of a capture; neither a scale nor a width: their own size, up to `MAX_WIDTH`.

    Raises:
        UserError: there are no views, or a size that is not possible.
    """
    if not views:
        raise UserError(f"{capture.root}: no such views", "choose --views train or turntable")
    shots = []
    for view in views:
        camera = capture.normalisation.camera(view.camera)
        sized = resized(camera, _factor(camera, scale, width))
        same = (sized.width, sized.height) == (camera.width, camera.height)
        shots.append(Shot(view.name, sized, view if same else None))
    return shots


def turntable(capture: Capture, frames: int, scale: float | None, width: int | None) -> list[Shot]:
    """Cameras on a circle about the scene's +z, facing its centre; height, distance, lens as captured.

    Distance and elevation are the medians of the capture's cameras; the lens is that of the view whose
    distance is nearest to the median, straightened.

    Raises:
        UserError: fewer than 2 or more than 9999 frames, or a size that is not possible.
    """
    if not 2 <= frames <= 9999:
        raise UserError(f"a turntable of {frames} frames", "give 2 to 9999 with --frames")
    cameras = [capture.normalisation.camera(view.camera) for view in capture.views]
    eyes = np.stack([camera.c2w[:, 3] for camera in cameras])
    distances = np.linalg.norm(eyes, axis=-1).clip(1e-6)
    distance = float(np.median(distances))
    elevation = float(np.median(np.arcsin((eyes[:, 2] / distances).clip(-1, 1))))
    # Straight from above there is no up; a tenth of a degree is enough for one.
    elevation = float(np.clip(elevation, -math.pi / 2 + 2e-3, math.pi / 2 - 2e-3))
    like = cameras[int(np.abs(distances - distance).argmin())]
    like = replace(like, lens=None, cx=like.width / 2, cy=like.height / 2)
    like = resized(like, _factor(like, scale, width))
    azimuths = 2 * math.pi * np.arange(frames) / frames
    return [
        Shot(f"turn_{k:04d}", replace(like, w2c=_looking_in(distance, elevation, azimuth)))
        for k, azimuth in enumerate(azimuths)
    ]


def resized(camera: Camera, factor: float) -> Camera:
    """The same picture in another size; a lens bends the unit plane and stays.

    Raises:
        UserError: the size is below 1 or above 8192 pixels a side.
    """
    width, height = round(camera.width * factor), round(camera.height * factor)
    if not (1 <= width <= MAX_SIDE and 1 <= height <= MAX_SIDE):
        raise UserError(
            f"a picture of {width}×{height} pixels", f"choose --scale or --width for 1 to {MAX_SIDE} a side"
        )
    x, y = width / camera.width, height / camera.height
    sizes = {"fx": camera.fx * x, "cx": camera.cx * x, "fy": camera.fy * y, "cy": camera.cy * y}
    return replace(camera, **sizes, width=width, height=height)


def rays_through(camera: Camera, points: Float[Tensor, "N 2"]) -> tuple[RayBatch, Bool[Tensor, " N"]]:
    """Rays through image points (column + ½ at a pixel's centre), in the frame of the pose, and which of them
    there are: a lens may show nothing at a point."""
    plane = (points.double().cpu().numpy() - camera.intrinsics[2:]) / camera.intrinsics[:2]
    if camera.lens is not None:
        plane = camera.lens.straighten(plane)
    shown = np.isfinite(plane).all(axis=1)
    local = np.concatenate([np.where(shown[:, None], plane, 0.0), np.ones((len(plane), 1))], axis=1)
    pose = camera.c2w
    directions = (local / np.linalg.norm(local, axis=1, keepdims=True)) @ pose[:, :3].T
    origins = np.broadcast_to(pose[:, 3], directions.shape)
    rays = RayBatch(
        *(torch.from_numpy(part.astype(np.float32)).to(points.device) for part in (origins, directions))
    )
    return rays, torch.from_numpy(shown).to(points.device)


def _factor(camera: Camera, scale: float | None, width: int | None) -> float:
    if width is not None:
        return width / camera.width
    if scale is not None:
        return scale
    return min(1.0, MAX_WIDTH / camera.width)


def _looking_in(distance: float, elevation: float, azimuth: float) -> Float64[np.ndarray, "4 4"]:
    """World to camera from a place on a sphere about the origin, upright."""
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
