"""Find the triangles of a surface that cameras see."""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np
import torch
from jaxtyping import Bool

from neilfpp_method.data.cameras.camera import Camera
from neilfpp_method.data.cameras.projection import CameraRays, pixel_index, project
from neilfpp_method.export.asset.surface import AssetSurface, first_hits

__all__ = ["visible_faces"]

MAX_RAYS = 2**24
"""Largest number of rays through pixels, over all cameras; it takes 15 s with Embree. Triangles that these
rays miss are tested separately.
"""
RAYS_AT_ONCE = 2**20
"""Number of rays per batch, which bounds the memory."""
NEAR = 1e-3
"""Largest distance, scene units, between the centres of a triangle and of the one that a ray towards it hits,
for the triangle to count as visible.
"""


@torch.no_grad()
def visible_faces(surface: AssetSurface, cameras: Sequence[Camera]) -> Bool[np.ndarray, " F"]:
    """Find the triangles whose outside is the first hit of a ray through a pixel, or whose centre is visible.

    Rays through pixels find large triangles; rays to the centres find triangles smaller than a pixel.

    Args:
        surface: the surface.
        cameras: cameras in the scene frame.
    """
    tracer, mesh = first_hits(surface), surface.mesh()
    outward = torch.from_numpy(np.array(mesh.face_normals)).float()
    center = torch.from_numpy(np.array(mesh.triangles_center)).float()
    visible = torch.zeros(len(surface.faces), dtype=torch.bool)
    stride = math.ceil(sum(camera.width * camera.height for camera in cameras) / MAX_RAYS)
    for camera in cameras:
        rays = CameraRays([camera])
        for pixel in torch.arange(0, camera.width * camera.height, stride).split(RAYS_AT_ONCE):
            batch = rays(torch.zeros_like(pixel), pixel)
            face = tracer(batch.origins, batch.directions)
            is_hit = face >= 0
            face, directions = face[is_hit], batch.directions[is_hit]
            visible[face[(outward[face] * directions).sum(-1) < 0]] = True
    for camera in cameras:
        eye = torch.from_numpy(camera.c2w[:, 3]).float()
        rows = torch.nonzero(~visible & (((eye - center) * outward).sum(-1) > 0))[:, 0]
        in_image = pixel_index(project(camera, center[rows]), camera) >= 0
        for part in rows[in_image].split(RAYS_AT_ONCE):
            direction = center[part] - eye
            face = tracer(eye.expand_as(direction), torch.nn.functional.normalize(direction, dim=-1))
            # Near an edge the ray may hit the neighbouring triangle instead.
            neighbor = (center[face.clamp_min(0)] - center[part]).norm(dim=-1) < NEAR
            visible[part[(face == part) | ((face >= 0) & neighbor)]] = True
    return visible.numpy()
