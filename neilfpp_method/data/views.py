"""What a capture is made of: cameras, views, and the map from the world to the scene frame.

Cameras are pinholes with OpenCV axes (x right, y down, z forward) and pixel centres at +0.5: pixel (column, row) is
seen through the image point (column + ½, row + ½).
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import torch
from jaxtyping import Float, Float64, Int
from torch import Tensor

from neilfpp_method.errors import UserError
from neilfpp_method.structures import RayBatch

__all__ = [
    "Camera",
    "CaptureFiles",
    "Normalisation",
    "Projection",
    "View",
    "camera_rays",
    "check_camera",
    "inside",
    "pixel_rays",
    "project",
]


@dataclass(frozen=True, eq=False)
class Camera:
    """A pinhole: focal lengths and principal point in pixels, size in pixels, and the pose, world (or scene) to camera.

    Cameras are compared by identity: an array has no single truth value.
    """

    fx: float
    fy: float
    cx: float
    cy: float
    width: int
    height: int
    w2c: Float64[np.ndarray, "4 4"]

    @property
    def intrinsics(self) -> Float64[np.ndarray, " 4"]:
        """fx, fy, cx, cy."""
        return np.array([self.fx, self.fy, self.cx, self.cy])

    @property
    def c2w(self) -> Float64[np.ndarray, "3 4"]:
        """Camera to world: the transposed rotation, and the camera's centre in the last column."""
        rotation = self.w2c[:3, :3].T
        return np.concatenate([rotation, -rotation @ self.w2c[:3, 3:]], axis=1)


def check_camera(camera: Camera, where: str) -> None:
    """Refuse what is no pinhole with a rigid pose; `where` says to whom the camera belongs.

    Raises:
        UserError: the camera is malformed.
    """
    rotation = camera.w2c[:3, :3]
    if not (np.isfinite(camera.w2c).all() and np.isfinite(camera.intrinsics).all()):
        raise UserError(f"{where}: the camera has a number that is not finite", "export the cameras again")
    if min(camera.fx, camera.fy) <= 0:
        raise UserError(f"{where}: the focal length is not positive", "give it in pixels")
    if min(camera.width, camera.height) < 1:
        raise UserError(f"{where}: the image size is not positive", "give width and height in pixels")
    rigid = np.abs(rotation @ rotation.T - np.eye(3)).max() < 1e-3 and np.linalg.det(rotation) > 0
    if not rigid or not np.allclose(camera.w2c[3], [0, 0, 0, 1]):
        raise UserError(
            f"{where}: the extrinsic is no rotation and translation", "give world-to-camera, 4×4, row-major"
        )


@dataclass(frozen=True)
class View:
    """One image with its camera in the world frame.

    `name` is the image's stem, unique in the capture; `index` its number in the capture's own list, which counts views
    that are left out as well.
    """

    name: str
    index: int
    camera: Camera
    image: Path
    mask: Path | None = None


@dataclass(frozen=True)
class Normalisation:
    """scene = (world − centre) / scale: no rotation, so that directions and normals are the same in both frames."""

    scale: float
    centre: tuple[float, float, float]

    def to_scene(self, points: Float[Tensor, "*N 3"]) -> Float[Tensor, "*N 3"]:
        """World positions in the scene frame."""
        return (points - points.new_tensor(self.centre)) / self.scale

    def to_world(self, points: Float[Tensor, "*N 3"]) -> Float[Tensor, "*N 3"]:
        """Scene positions in the world frame."""
        return points * self.scale + points.new_tensor(self.centre)

    def camera(self, camera: Camera) -> Camera:
        """The camera in the scene frame: the same image, with depths divided by `scale`."""
        w2c = camera.w2c.copy()
        w2c[:3, 3] = (w2c[:3, :3] @ np.array(self.centre) + w2c[:3, 3]) / self.scale
        return replace(camera, w2c=w2c)


@dataclass(frozen=True)
class CaptureFiles:
    """What a reader finds in a folder: the views in order, the scene frame, and where the rest lies.

    `inputs` is the folder that listed paths start from: masks, depth maps and the like lie in it.
    """

    inputs: Path
    views: tuple[View, ...]
    normalisation: Normalisation
    point_cloud: Path | None = None


def inside(root: Path, path: Path) -> Path:
    """The path itself, when it leads to a place under `root` once links are followed.

    Raises:
        UserError: it leaves `root`, or is no path at all; a capture from a stranger could otherwise read any file.
    """
    try:
        path.exists()  # raises where the name itself is not possible
        if path.resolve().is_relative_to(root.resolve()):
            return path
    except (OSError, RuntimeError, ValueError):  # a name too long, a loop of links, a null byte
        pass
    raise UserError(f"{path}: not a path within the capture folder {root}", "copy the file into the folder")


# ----------------------------------------------------------------------------------------------------------- projection


@dataclass(frozen=True)
class Projection:
    """Image points (column + ½ at a pixel's centre) and depth along the camera's axis, in the units of the pose."""

    pixel: Float[Tensor, "N 2"]
    depth: Float[Tensor, " N"]


def project(camera: Camera, points: Float[Tensor, "N 3"]) -> Projection:
    """Where the camera sees points: u = fx·x/z + cx, v = fy·y/z + cy. A depth ≤ 0 means the point is behind it."""
    w2c = torch.as_tensor(camera.w2c, dtype=points.dtype, device=points.device)
    intrinsics = torch.as_tensor(camera.intrinsics, dtype=points.dtype, device=points.device)
    local = points @ w2c[:3, :3].T + w2c[:3, 3]
    depth = local[:, 2]
    return Projection(local[:, :2] / depth[:, None] * intrinsics[:2] + intrinsics[2:], depth)


def pixel_rays(
    intrinsics: Float[Tensor, "N 4"], c2w: Float[Tensor, "N 3 4"], columns: Int[Tensor, " N"], rows: Int[Tensor, " N"]
) -> RayBatch:
    """Rays through the centres of pixels, each with its own camera; in the frame of `c2w`."""
    pixels = torch.stack([columns, rows], dim=-1).to(intrinsics.dtype) + 0.5
    plane = (pixels - intrinsics[:, 2:]) / intrinsics[:, :2]
    local = torch.nn.functional.pad(plane, (0, 1), value=1.0)
    directions = torch.einsum("nij,nj->ni", c2w[:, :, :3], torch.nn.functional.normalize(local, dim=-1))
    return RayBatch(c2w[:, :, 3], directions)


def camera_rays(camera: Camera, dtype: torch.dtype = torch.float32) -> RayBatch:
    """Rays through all pixels, row by row: N = height · width, in the frame of the camera's pose."""
    pixel = torch.arange(camera.height * camera.width)
    intrinsics = torch.as_tensor(camera.intrinsics, dtype=dtype).expand(len(pixel), 4)
    c2w = torch.as_tensor(camera.c2w, dtype=dtype).expand(len(pixel), 3, 4)
    return pixel_rays(intrinsics, c2w, pixel % camera.width, pixel // camera.width)
