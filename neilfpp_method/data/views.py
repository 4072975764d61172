"""The parts of a capture: cameras, views, and the transformation from the world frame to the scene frame.

Cameras have OpenCV axes (x right, y down, z forward). The centre of pixel (column, row) is the image point
(column + ½, row + ½). A camera without a `Lens` is a pinhole camera.
"""

from __future__ import annotations

import itertools
import os
from collections.abc import Hashable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Literal

import numpy as np
import torch
from jaxtyping import Bool, Float, Float64, Int
from torch import Tensor

from neilfpp_method.data.lens import Lens
from neilfpp_method.errors import UserError
from neilfpp_method.structures import RayBatch

__all__ = [
    "Camera",
    "CameraRays",
    "CaptureFiles",
    "Normalization",
    "Projection",
    "SceneSource",
    "View",
    "camera_rays",
    "check_camera",
    "inside",
    "pixel_index",
    "plain_name",
    "project",
    "scaled_camera",
]

MAX_BLIND_SHARE = 0.6
"""Largest share of an image at which a lens may show nothing: the circle of a fisheye fills 44 % of a 16:9
image."""
MAX_TABULATED = 2**26
"""Largest number of pixels, over all different lenses, whose rays are stored: half a gigabyte."""
PLANE_PART = 2**20
"""Number of pixels whose rays are computed at once; bounds the memory."""
MIN_FOCAL, LARGEST = 1e-3, 1e12
"""Smallest focal length, in pixels, and largest absolute value of any number of a camera, so that rays can be
computed in float32."""


@dataclass(frozen=True, eq=False)
class Camera:
    """Focal lengths, principal point and size in pixels, and the pose from world (or scene) to camera.

    Without `lens` it is a pinhole camera. With it, focal lengths and principal point apply to the distorted
    image plane. Cameras are compared by identity, because the comparison of arrays has no single truth value.
    """

    fx: float
    fy: float
    cx: float
    cy: float
    width: int
    height: int
    w2c: Float64[np.ndarray, "4 4"]
    lens: Lens | None = None

    @property
    def intrinsics(self) -> Float64[np.ndarray, " 4"]:
        """The numbers fx, fy, cx, cy."""
        return np.array([self.fx, self.fy, self.cx, self.cy])

    @property
    def c2w(self) -> Float64[np.ndarray, "3 4"]:
        """Camera to world: the transposed rotation, with the camera's centre as the last column."""
        rotation = self.w2c[:3, :3].T
        return np.concatenate([rotation, -rotation @ self.w2c[:3, 3:]], axis=1)


def scaled_camera(camera: Camera, width: int, height: int) -> Camera:
    """Return the camera with the same field of view and another number of pixels.

    >>> camera = Camera(500.0, 500.0, 200.0, 150.0, 400, 300, np.eye(4))
    >>> half = scaled_camera(camera, 200, 150)
    >>> half.fx, half.cx, half.cy
    (250.0, 100.0, 75.0)
    """
    right, down = width / camera.width, height / camera.height
    return replace(
        camera,
        fx=camera.fx * right,
        fy=camera.fy * down,
        cx=camera.cx * right,
        cy=camera.cy * down,
        width=width,
        height=height,
    )


def check_camera(camera: Camera, where: str) -> None:
    """Check that a camera has finite numbers in a usable range and a rigid pose.

    Args:
        camera: the camera.
        where: the file or view to which the camera belongs, for the message.

    Raises:
        UserError: it does not.
    """
    rotation = camera.w2c[:3, :3]
    if not (np.isfinite(camera.w2c).all() and np.isfinite(camera.intrinsics).all()):
        raise UserError(f"{where}: the camera has a number that is not finite", "export the cameras again")
    if min(camera.fx, camera.fy) <= 0:
        raise UserError(f"{where}: the focal length is not positive", "give the focal length in pixels")
    if min(camera.fx, camera.fy) < MIN_FOCAL or max(*abs(camera.intrinsics), abs(camera.w2c).max()) > LARGEST:
        raise UserError(
            f"{where}: the camera has a focal length below {MIN_FOCAL:g} px or a number beyond {LARGEST:g}",
            "export the cameras again",
        )
    if min(camera.width, camera.height) < 1:
        raise UserError(f"{where}: the image size is not positive", "give width and height in pixels")
    orthogonal = np.abs(rotation @ rotation.T - np.eye(3)).max() < 1e-3
    if not orthogonal or not np.allclose(camera.w2c[3], [0, 0, 0, 1]):
        raise UserError(
            f"{where}: the extrinsic matrix is not a rotation and a translation",
            "give world-to-camera, 4×4, row-major",
        )
    if np.linalg.det(rotation) < 0:
        raise UserError(
            f"{where}: the pose mirrors the scene (determinant −1)",
            "negate one axis of the camera: x points right, y down and z forward (OpenGL: y up and z back)",
        )
    if camera.lens is not None:
        camera.lens.check(where)


@dataclass(frozen=True)
class View:
    """One image with its camera in the world frame.

    Linear radiance = pixel / (`exposure` · `white_balance`), so that all images of a capture have one scale.

    Attributes:
        name: unique in the capture and a valid file name, in most layouts the stem of the image.
        index: number of the view in the layout's own list, which also counts views that are left out.
        camera: the camera, in the world frame.
        image: the image.
        mask: mask of the object, white on it; None if there is none.
        valid: validity mask, black where a pixel is saturated or has no meaning; None if all pixels are
            valid.
        exposure: exposure relative to other views.
        white_balance: factors of red, green and blue.
        file_size: width and height of the files if the camera has another size (`scaling`), to which pixels
            are scaled when they are read; else None.
    """

    name: str
    index: int
    camera: Camera
    image: Path
    mask: Path | None = None
    valid: Path | None = None
    exposure: float = 1.0
    white_balance: tuple[float, float, float] = (1.0, 1.0, 1.0)
    file_size: tuple[int, int] | None = None


@dataclass(frozen=True)
class Normalization:
    """scene = (world − centre) / scale: without rotation, directions are the same in both frames."""

    scale: float
    center: tuple[float, float, float]

    def to_scene(self, points: Float[Tensor, "*N 3"]) -> Float[Tensor, "*N 3"]:
        """Transform positions from the world frame to the scene frame."""
        return (points - points.new_tensor(self.center)) / self.scale

    def to_world(self, points: Float[Tensor, "*N 3"]) -> Float[Tensor, "*N 3"]:
        """Transform positions from the scene frame to the world frame."""
        return points * self.scale + points.new_tensor(self.center)

    def camera(self, camera: Camera) -> Camera:
        """Return the camera in the scene frame: with the same image, and depths divided by `scale`."""
        w2c = camera.w2c.copy()
        w2c[:3, 3] = (w2c[:3, :3] @ np.array(self.center) + w2c[:3, 3]) / self.scale
        return replace(camera, w2c=w2c)


SceneSource = Literal["box", "points", "focus", "masks", "cameras"]
"""Source of the scene box: the capture states it ("box"); points; the point that the cameras look at, because
the points extend far beyond it ("focus"); the visual hull of the masks; or only the cameras."""


@dataclass(frozen=True)
class CaptureFiles:
    """The content of a capture folder, as a reader returns it.

    Attributes:
        inputs: folder to which listed paths are relative, with masks, depth maps and other files.
        views: the views, in order.
        normalization: the transformation from the world frame to the scene frame.
        point_cloud: oriented point cloud; None if there is none.
        test: names of the test views; None if the capture states no split.
        hdr: whether pixels are linear radiance; None if the capture does not state it.
        scene_from: source of the normalisation.
    """

    inputs: Path
    views: tuple[View, ...]
    normalization: Normalization
    point_cloud: Path | None = None
    test: frozenset[str] | None = None
    hdr: bool | None = None
    scene_from: SceneSource = "box"


def inside(root: Path, path: Path) -> Path:
    """Return `path` if it is inside of `root` after links have been resolved.

    Without this check, a capture from an untrusted source could make the program read any file.

    Raises:
        UserError: the path leaves `root`, or is not a valid path.
    """
    try:
        # `exists` raises an exception for an impossible name.
        path.exists()
        if path.resolve().is_relative_to(root.resolve()):
            return path
        if path.exists() and Path(os.path.abspath(path)).is_relative_to(os.path.abspath(root)):
            link = next(p for p in (path, *path.parents) if p.is_symlink())
            problem = f"{path}: not a path within the capture folder {root}, because {link.name} is a link"
            raise UserError(problem, "replace the link by a copy of its files, as cp -rL makes it")
    except (OSError, RuntimeError, ValueError):
        # The name is too long, links form a loop, or the name contains a null byte.
        pass
    raise UserError(f"{path}: not a path within the capture folder {root}", "copy the file into the folder")


def plain_name(name: str) -> bool:
    """Return whether a name is a valid file name on all systems: without folders, not hidden, printable."""
    return bool(name) and name.isprintable() and not name.startswith(".") and not set(name) & set("/\\:")


# ------------------------------------------------------------------------------------------------- projection


@dataclass(frozen=True)
class Projection:
    """Image points and depths.

    Attributes:
        pixel: image points (column, row), in pixels, with the centres of pixels at +½.
        depth: depth along the camera's axis, in the unit of its pose.
    """

    pixel: Float[Tensor, "N 2"]
    depth: Float[Tensor, " N"]


def project(camera: Camera, points: Float[Tensor, "N 3"]) -> Projection:
    """Project points into the image: u = fx·x/z + cx, v = fy·y/z + cy, where the lens distorts (x/z, y/z).

    A point with depth ≤ 0 is behind the camera. The result is differentiable if the camera has no lens.
    """
    w2c = torch.as_tensor(camera.w2c, dtype=points.dtype, device=points.device)
    intrinsics = torch.as_tensor(camera.intrinsics, dtype=points.dtype, device=points.device)
    local = points @ w2c[:3, :3].T + w2c[:3, 3]
    depth = local[:, 2]
    plane = local[:, :2] / depth[:, None]
    if camera.lens is not None:
        plane = torch.as_tensor(camera.lens.bend(plane.detach().cpu().double().numpy())).to(plane)
    return Projection(plane * intrinsics[:2] + intrinsics[2:], depth)


def pixel_index(projected: Projection, camera: Camera) -> Int[Tensor, " N"]:
    """Row-major index of the pixel that each projected point falls in; −1 outside of the image."""
    size = projected.pixel.new_tensor([camera.width, camera.height])
    inside = (projected.depth > 0) & ((projected.pixel >= 0) & (projected.pixel < size)).all(-1)
    column, row = torch.where(inside[:, None], projected.pixel, 0.0).long().unbind(-1)
    return torch.where(inside, row * camera.width + column, -1)


def camera_rays(camera: Camera, dtype: torch.dtype = torch.float32) -> RayBatch:
    """Return rays through all N = height · width pixels, row by row, in the frame of the camera's pose."""
    pixel = torch.arange(camera.height * camera.width)
    return CameraRays([camera], dtype=dtype)(torch.zeros_like(pixel), pixel)


class CameraRays:
    """Rays through the centres of pixels of many cameras, in the frame of their poses.

    The rays of a pinhole camera are computed on demand. Those of a lens are read from a table, because the
    equations of a lens have no closed-form inverse. The table takes 8 bytes per pixel, and cameras that
    differ only in their pose share it. If the lenses have more than `MAX_TABULATED` pixels in total, for
    example because every photograph was calibrated separately, their rays are computed on demand as well,
    which takes longer. A pixel at which a lens shows nothing, such as in the corners of a fisheye image, has
    a ray that points backwards, away from the scene.

    Raises:
        UserError: a lens shows nothing at more than `MAX_BLIND_SHARE` of its pixels.
    """

    def __init__(
        self,
        cameras: Sequence[Camera],
        device: torch.device | str = "cpu",
        dtype: torch.dtype = torch.float32,
    ) -> None:
        self._intrinsics = torch.tensor(np.stack([c.intrinsics for c in cameras]), dtype=dtype, device=device)
        self._c2w = torch.tensor(np.stack([c.c2w for c in cameras]), dtype=dtype, device=device)
        self._width = torch.tensor([camera.width for camera in cameras], device=device)
        self._cameras = tuple(cameras)
        kinds = {_shape(camera): camera for camera in cameras if camera.lens is not None}
        sizes = [camera.width * camera.height for camera in kinds.values()]
        self._bent = torch.tensor([camera.lens is not None for camera in cameras], device=device)
        self._lens_plane: Float[Tensor, "P 2"] | None = None
        if kinds and sum(sizes) <= MAX_TABULATED:
            starts = dict(zip(kinds, itertools.accumulate(sizes, initial=0), strict=False))
            self._lens_start = torch.tensor(
                [starts.get(_shape(camera), 0) for camera in cameras], device=device
            )
            planes = np.concatenate([_whole_plane(camera, dtype) for camera in kinds.values()])
            self._lens_plane = torch.from_numpy(planes).to(device)

    def has_ray(self, i: int) -> Bool[Tensor, " P"]:
        """Return which pixels of camera `i`, row by row, have a ray: its lens shows something there."""
        camera = self._cameras[i]
        size = camera.width * camera.height
        if camera.lens is None:
            return torch.ones(size, dtype=torch.bool, device=self._width.device)
        if self._lens_plane is not None:
            start = int(self._lens_start[i])
            return ~self._lens_plane[start : start + size].isnan().any(dim=-1)
        plane = torch.from_numpy(_whole_plane(camera, self._intrinsics.dtype))
        return ~plane.isnan().any(dim=-1).to(self._width.device)

    def __call__(self, camera: Int[Tensor, " N"], pixel: Int[Tensor, " N"]) -> RayBatch:
        """Return the rays through pixels, given by the index of their camera and their index in its image."""
        width, intrinsics, c2w = self._width[camera], self._intrinsics[camera], self._c2w[camera]
        corner = torch.stack([pixel % width, pixel // width], dim=-1)
        plane = (corner.to(intrinsics.dtype) + 0.5 - intrinsics[:, 2:]) / intrinsics[:, :2]
        if self._lens_plane is not None:
            bent = self._bent[camera]
            looked_up = self._lens_plane[torch.where(bent, self._lens_start[camera] + pixel, 0)]
            plane = torch.where(bent[:, None], looked_up, plane)
        elif self._bent.any():
            plane = self._computed(plane, camera, pixel)
        local = torch.nn.functional.pad(plane, (0, 1), value=1.0)
        if self._bent.any():
            local = torch.where(
                local.isnan().any(dim=-1, keepdim=True), local.new_tensor([0.0, 0.0, -1.0]), local
            )
        directions = torch.einsum("nij,nj->ni", c2w[:, :, :3], torch.nn.functional.normalize(local, dim=-1))
        return RayBatch(c2w[:, :, 3], directions)

    def _computed(
        self, plane: Float[Tensor, "N 2"], camera: Int[Tensor, " N"], pixel: Int[Tensor, " N"]
    ) -> Float[Tensor, "N 2"]:
        """Replace the entries of `plane` that belong to cameras with a lens by the undistorted points."""
        plane = plane.clone()
        for i in camera.unique().tolist():
            if self._cameras[i].lens is not None:
                rows = torch.nonzero(camera == i)[:, 0]
                straight = _straight_plane(self._cameras[i], pixel[rows].cpu().numpy())
                plane[rows] = torch.from_numpy(straight).to(plane)
        return plane


def _shape(camera: Camera) -> Hashable:
    """A key of everything about a camera except its pose."""
    return (camera.lens, camera.fx, camera.fy, camera.cx, camera.cy, camera.width, camera.height)


def _whole_plane(camera: Camera, dtype: torch.dtype) -> Float[np.ndarray, "P 2"]:
    """`_straight_plane` of all pixels of a camera, in the precision of rays; in parts to bound memory."""
    count = camera.width * camera.height
    parts = np.split(np.arange(count), range(PLANE_PART, count, PLANE_PART))
    plane = np.concatenate(
        [torch.from_numpy(_straight_plane(camera, part)).to(dtype).numpy() for part in parts]
    )
    blind = int(np.isnan(plane).any(axis=1).sum())
    if blind > MAX_BLIND_SHARE * count:
        raise UserError(
            f"a camera of the lens {camera.lens.model} shows nothing at {blind} of its {count} pixels",
            "crop or undistort the images, or calibrate the camera again",
        )
    return plane


def _straight_plane(camera: Camera, pixel: Int[np.ndarray, " N"]) -> Float64[np.ndarray, "N 2"]:
    """Points of the plane at depth 1 that rays of a camera with a lens meet; NaN if a pixel has no ray."""
    centers = np.stack([pixel % camera.width, pixel // camera.width], axis=1) + 0.5
    return camera.lens.straighten((centers - camera.intrinsics[2:]) / camera.intrinsics[:2])
