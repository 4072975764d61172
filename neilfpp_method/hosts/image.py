"""Whole images as hits: what a rasteriser draws (splats, meshes), a row per pixel.

hits = image_hits(camera, color, depth, opacity)        # (H, W, 3), (H, W), (H, W) as the rasteriser returns
them batch = pixel_batch(rays.origins, rays.directions, photograph.reshape(-1, 3))       # rays =
camera_rays(camera) loss = loss + neilf.losses(batch[rows], step, hits[rows]).loss
"""

from __future__ import annotations

import torch
from jaxtyping import Float
from torch import Tensor

from neilfpp_method.data.views import Camera, camera_rays
from neilfpp_method.errors import UserError
from neilfpp_method.shading.frame import safe_normalize
from neilfpp_method.structures import RayBatch, SurfaceHits

__all__ = ["depth_normals", "image_hits", "rays_like"]

JUMP = 0.1
"""Neighbouring pixels whose distances differ by more than this share of them are on two surfaces."""
SOLID = 0.5
"""Least opacity of a pixel that has a surface."""


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
    """Maps of one view as hits, H·W rows, row by row; gradients pass.

    Args:
        camera: in the scene frame, OpenCV axes.
        color: linear radiance, background included.
        depth: of the surface, scene units, along the camera's axis (z-depth, what rasterisers draw). Blended
            depths are to be divided by the opacity before.
        opacity: share of the ray that the surface stops. A pixel below one half is a miss.
        normal: of any length, scene frame, away from the surface; none: of the depths of neighbouring pixels.
        along_ray: depth is a distance along the ray.

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
                f"the {name} of an image has the shape {shape}", f"give {wanted}, as the camera has it"
            )
    rays = rays_like(camera, color)
    axis = torch.as_tensor(camera.w2c[2, :3], dtype=color.dtype, device=color.device)
    distance = depth.reshape(-1) if along_ray else depth.reshape(-1) / (rays.directions @ axis)
    position = rays.origins + distance[:, None] * rays.directions
    if normal is None:
        normal = depth_normals(position.view(*size, 3), rays.origins[0])
    solid = opacity.detach().reshape(-1) > SOLID
    unit = safe_normalize(normal.reshape(-1, 3)) * solid[:, None]
    hit = solid & (unit.detach().norm(dim=-1) > SOLID)
    concentration = opacity.detach().reshape(-1) * hit
    return SurfaceHits(
        color=color.reshape(-1, 3),
        position=torch.where(solid[:, None], position, rays.origins),
        normal=unit,
        opacity=opacity.reshape(-1),
        concentration=concentration,
    )


def depth_normals(position: Float[Tensor, "H W 3"], eye: Float[Tensor, " 3"]) -> Float[Tensor, "H W 3"]:
    """Unit normals of a surface from the positions of pixels, towards the eye: the cross product of the steps
    to the nearer of both neighbours along each axis. Zero where a neighbour lies on another surface.
    """
    distance = (position - eye).norm(dim=-1)
    right, right_ok = _nearer_step(position, distance, 1)
    down, down_ok = _nearer_step(position, distance, 0)
    normal = safe_normalize(torch.linalg.cross(right, down))
    towards = ((eye - position) * normal).sum(-1, keepdim=True)
    return torch.where(towards < 0, -normal, normal) * (right_ok & down_ok)[..., None]


def _nearer_step(
    position: Float[Tensor, "H W 3"], distance: Float[Tensor, "H W"], axis: int
) -> tuple[Tensor, Tensor]:
    """The step along an axis to the neighbour of nearest depth, and whether it is on the same surface."""
    forward, backward = (position.roll(-1, axis) - position), (position - position.roll(1, axis))
    rise = (distance.roll(-1, axis) - distance).abs()
    edge = torch.arange(position.shape[axis], device=position.device).view(-1, *([1] * (1 - axis)))
    rise = torch.where(edge == position.shape[axis] - 1, torch.inf, rise)
    fall = (distance - distance.roll(1, axis)).abs()
    fall = torch.where(edge == 0, torch.inf, fall)
    step = torch.where((rise <= fall)[..., None], forward, backward)
    return step, torch.minimum(rise, fall) < JUMP * distance
