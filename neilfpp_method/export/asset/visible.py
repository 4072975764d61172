"""Which triangles of a surface the cameras saw."""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np
import torch
from jaxtyping import Bool

from neilfpp_method.data.views import Camera, CameraRays, project
from neilfpp_method.export.asset.surface import Surface, first_hits

__all__ = ["seen_faces"]

MAX_RAYS = 2**24
"""Rays through pixels of all cameras together: 15 s with Embree. Faces they miss are tested alone."""
RAYS_AT_ONCE = 2**20
NEAR = 1e-3
"""Scene units that may lie between a triangle's middle and what a ray towards it meets."""


@torch.no_grad()
def seen_faces(surface: Surface, cameras: Sequence[Camera]) -> Bool[np.ndarray, " F"]:
    """The triangles whose outside a ray through a pixel meets first, or whose middle a camera has in view.

    Large triangles are found by the pixels, triangles smaller than a pixel by their middles.

    Args:
        surface: triangles.
        cameras: in the scene frame.
    """
    tracer, mesh = first_hits(surface), surface.mesh()
    outward = torch.from_numpy(np.array(mesh.face_normals)).float()
    middle = torch.from_numpy(np.array(mesh.triangles_center)).float()
    seen = torch.zeros(len(surface.faces), dtype=torch.bool)
    stride = math.ceil(sum(camera.width * camera.height for camera in cameras) / MAX_RAYS)
    for camera in cameras:
        rays = CameraRays([camera])
        for pixel in torch.arange(0, camera.width * camera.height, stride).split(RAYS_AT_ONCE):
            batch = rays(torch.zeros_like(pixel), pixel)
            face = tracer(batch.origins, batch.directions)
            met = face >= 0
            face, directions = face[met], batch.directions[met]
            seen[face[(outward[face] * directions).sum(-1) < 0]] = True
    for camera in cameras:
        eye = torch.from_numpy(camera.c2w[:, 3]).float()
        rows = torch.nonzero(~seen & (((eye - middle) * outward).sum(-1) > 0))[:, 0]
        shown = project(camera, middle[rows])
        size = shown.pixel.new_tensor([camera.width, camera.height])
        rows = rows[(shown.depth > 0) & (shown.pixel >= 0).all(-1) & (shown.pixel < size).all(-1)]
        for part in rows.split(RAYS_AT_ONCE):
            towards = middle[part] - eye
            face = tracer(eye.expand_as(towards), torch.nn.functional.normalize(towards, dim=-1))
            # Next to an edge the ray may meet the neighbour.
            beside = (middle[face.clamp_min(0)] - middle[part]).norm(dim=-1) < NEAR
            seen[part[(face == part) | ((face >= 0) & beside)]] = True
    return seen.numpy()
