"""From points to pixels and back: projection into a camera, and rays through the centres of pixels."""

from __future__ import annotations

import copy
import itertools
from collections.abc import Hashable, Sequence
from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Bool, Float, Float64, Int
from torch import Tensor

from neilfpp_method.data.cameras.camera import Camera
from neilfpp_method.errors import UserError
from neilfpp_method.structures import RayBatch

__all__ = ["CameraRays", "Projection", "camera_rays", "pixel_index", "project"]

MAX_BLIND_SHARE = 0.6
"""Largest share of an image at which a lens may show nothing: the circle of a fisheye fills 44 % of a 16:9
image."""
MAX_TABULATED = 2**26
"""Largest number of pixels, over all different lenses, whose rays are stored: half a gigabyte."""
PLANE_PART = 2**20
"""Number of pixels whose rays are computed at once; bounds the memory."""


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

    def posed(self, cameras: Sequence[Camera]) -> CameraRays:
        """Return the rays of cameras that differ from these only in their poses."""
        other = copy.copy(self)
        other._c2w = torch.tensor(np.stack([c.c2w for c in cameras])).to(self._c2w)
        other._cameras = tuple(cameras)
        return other

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
