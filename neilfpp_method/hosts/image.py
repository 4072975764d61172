"""Convert whole images of a rasteriser (splats, meshes) to hits, one row per pixel.

Example:
    # color (H, W, 3), depth (H, W) and opacity (H, W), as the rasteriser returns them
    hits = image_hits(camera, color, depth, opacity)
    rays = camera_rays(camera)
    batch = pixel_batch(rays.origins, rays.directions, photograph.reshape(-1, 3))
    loss = loss + neilf.losses(batch[rows], step, hits[rows]).loss
"""

from __future__ import annotations

from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from neilfpp_method.data.cameras.camera import Camera
from neilfpp_method.data.cameras.projection import camera_rays
from neilfpp_method.errors import UserError
from neilfpp_method.shading.frame import safe_normalize
from neilfpp_method.structures import RayBatch, SurfaceHits

__all__ = ["depth_normals", "image_hits", "rays_like"]

MIN_RELATIVE_JUMP = 0.1
"""Relative difference of their distances above which neighbouring pixels belong to two surfaces."""
MIN_SOLID_OPACITY = 0.5
"""Smallest opacity of a pixel that shows a surface."""


def rays_like(camera: Camera, like: Tensor) -> RayBatch:
    """Rays through all pixels of a camera, row by row, on the device and in the float type of `like`."""
    return camera_rays(camera, like.dtype).to(like.device)


def image_hits(
    camera: Camera,
    color: Float[Tensor, "H W 3"],
    depth: Float[Tensor, "H W"],
    opacity: Float[Tensor, "H W"],
    normal: Float[Tensor, "H W 3"] | None = None,
    *,
    along_ray: bool = False,
) -> SurfaceHits:
    """Convert the maps of one view to hits: H·W rows in row-major order, with gradients.

    Args:
        camera: camera in the scene frame, OpenCV axes.
        color: linear radiance, background included.
        depth: depth of the surface along the camera's axis (z-depth), scene units. Divide blended depths by
            the opacity first.
        opacity: opacity of each pixel; below ½ the pixel is a miss.
        normal: outward normals of any length, scene frame; if None, they are computed from the depths of
            neighbouring pixels.
        along_ray: whether `depth` is the distance along the ray instead of the z-depth.

    Raises:
        UserError: a map has another size than the camera.
    """
    size = (camera.height, camera.width)
    maps = {"color": color, "depth": depth, "opacity": opacity} | (
        {} if normal is None else {"normal": normal}
    )
    for name, value in maps.items():
        wanted = (*size, 3) if name in ("color", "normal") else size
        if tuple(value.shape) != wanted:
            shape = tuple(value.shape)
            raise UserError(
                f"the {name} of an image has the shape {shape}", f"give {wanted}, the size of the camera"
            )
    # Colours may be in half precision, which is too coarse for positions.
    rays = rays_like(camera, depth)
    axis = torch.as_tensor(camera.w2c[2, :3], dtype=depth.dtype, device=depth.device)
    distance = depth.reshape(-1) if along_ray else depth.reshape(-1) / (rays.directions @ axis)
    position = rays.origins + distance[:, None] * rays.directions
    if normal is None:
        normal = depth_normals(position.view(*size, 3), rays.origins[0])
    solid = opacity.detach().reshape(-1) > MIN_SOLID_OPACITY
    unit = safe_normalize(normal.reshape(-1, 3)) * solid[:, None]
    has_normal = unit.detach().norm(dim=-1) > 0.5  # the length is 1, or 0 where no normal is known
    hit = solid & has_normal
    concentration = opacity.detach().reshape(-1) * hit
    return SurfaceHits(
        color=color.reshape(-1, 3),
        position=torch.where(solid[:, None], position, rays.origins),
        normal=unit,
        opacity=opacity.reshape(-1),
        concentration=concentration,
    )


def depth_normals(position: Float[Tensor, "H W 3"], eye: Float[Tensor, " 3"]) -> Float[Tensor, "H W 3"]:
    """Unit normals from the positions of pixels, oriented towards the eye.

    They are cross products of differences to the neighbour with the closer depth along each axis. A normal is
    zero if both neighbours along an axis lie on another surface.
    """
    distance = (position - eye).norm(dim=-1)
    right, down = (_nearer_step(position, distance, axis) for axis in (1, 0))
    normal = safe_normalize(torch.linalg.cross(right.offset, down.offset))
    towards = ((eye - position) * normal).sum(-1, keepdim=True)
    return torch.where(towards < 0, -normal, normal) * (right.on_one_surface & down.on_one_surface)[..., None]


@dataclass(frozen=True)
class _Step:
    """From each pixel to a neighbour: the offset in space, and whether both show one surface."""

    offset: Float[Tensor, "H W 3"]
    on_one_surface: Bool[Tensor, "H W"]


def _nearer_step(position: Float[Tensor, "H W 3"], distance: Float[Tensor, "H W"], axis: int) -> _Step:
    """The step to the neighbour of closer depth along an axis."""
    forward, backward = (position.roll(-1, axis) - position), (position - position.roll(1, axis))
    rise = (distance.roll(-1, axis) - distance).abs()
    edge = torch.arange(position.shape[axis], device=position.device).view(-1, *([1] * (1 - axis)))
    rise = torch.where(edge == position.shape[axis] - 1, torch.inf, rise)
    fall = (distance - distance.roll(1, axis)).abs()
    fall = torch.where(edge == 0, torch.inf, fall)
    offset = torch.where((rise <= fall)[..., None], forward, backward)
    return _Step(offset, torch.minimum(rise, fall) < MIN_RELATIVE_JUMP * distance)
