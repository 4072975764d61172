"""Sample and trace the rays of L_ref, which compares L with R at other surfaces (METHOD §2, §4)."""

from __future__ import annotations

import math
from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from neilfpp_method.hosts.base import Host, PredictsMisses
from neilfpp_method.incident.scene import off_surface
from neilfpp_method.losses import scale_gradient
from neilfpp_method.settings.types import MeshConfig, NeilfConfig
from neilfpp_method.shading.frame import local_frame
from neilfpp_method.structures import RayBatch

__all__ = ["TracedLight", "trace_light"]

MAX_ANGLE_DEG = 80.0
"""Largest angle of a ray from the normal, degrees. At larger angles a ray stays in the soft layer of its own
surface, and contributes little light.
"""
RADIANCE_GRADIENT = 0.7
"""Scale of the gradient of L_ref into R of a mesh, which is accurate because the geometry is given (published
code). R of recovered geometry gets no gradient: it must reproduce the images.
"""
MAX_START = 0.2
"""Largest distance of the start of a ray from its surface point, scene units (published code). A ray that has
to start further away is left out: it could start behind a neighbouring surface, and if it started closer, it
would hit the soft layer of its own surface.
"""


@dataclass(frozen=True)
class TracedLight:
    """Traced rays: their surface points and directions, the incident radiance, and which rays hit.

    It does not contain rays that would start too far away, nor rays that the host knows to miss.
    """

    position: Float[Tensor, "K 3"]
    wi: Float[Tensor, "K 3"]
    radiance: Float[Tensor, "K 3"]
    hit: Bool[Tensor, " K"]


def trace_light(
    host: Host,
    position: Float[Tensor, "N 3"],
    normal: Float[Tensor, "N 3"],
    config: NeilfConfig,
) -> TracedLight:
    """Trace random directions from random points through the host.

    Directions are uniform in solid angle within `MAX_ANGLE_DEG` of the normal. A ray starts at a height of
    `config.ray_offset` plus four widths of the host's surface above its point, so its displacement along the
    ray grows as 1/cos θ. Rays that would start further than `MAX_START` from their point are left out. No
    gradient flows into the positions: L_ref must not move the surface.

    Args:
        host: renders the rays.
        position: surface points, scene frame.
        normal: outward unit normals.
        config: the settings, with a free light: rays per point, their start, and what counts as a hit.
    """
    position, normal = position.detach(), normal.detach()
    chosen = _random_rows(position.shape[0], config.light.rays_per_point, position.device)
    position, normal = position[chosen], normal[chosen]
    wi = _cone_directions(normal, math.cos(math.radians(MAX_ANGLE_DEG)))
    start = off_surface(host, position, normal, wi, config.ray_offset)
    is_traced = (start - position).norm(dim=-1) <= MAX_START
    if isinstance(host, PredictsMisses):
        is_traced &= host.may_hit(RayBatch(start, wi))
    rows = torch.nonzero(is_traced)[:, 0]
    position, start, wi = position[rows], start[rows], wi[rows]
    trains_radiance = isinstance(config.host, MeshConfig)
    with torch.set_grad_enabled(torch.is_grad_enabled() and trains_radiance):
        hits = host.render(RayBatch(start, wi))
    radiance = scale_gradient(hits.color, RADIANCE_GRADIENT if trains_radiance else 0.0)
    return TracedLight(position, wi, radiance, hits.is_hit(config.shading.hit_share))


def _random_rows(points: int, per_point: float, device: torch.device) -> Tensor:
    """Rows of the points at which rays start: each ⌊per_point⌋ times, and random points for the rest."""
    whole = int(per_point)
    rest = round(points * (per_point - whole))
    return torch.cat(
        [torch.arange(points, device=device).repeat(whole), torch.randperm(points, device=device)[:rest]]
    )


def _cone_directions(normal: Float[Tensor, "K 3"], min_cosine: float) -> Float[Tensor, "K 3"]:
    """Directions uniform in the cone cos θ ≥ `min_cosine` about the normal."""
    azimuth = 2.0 * math.pi * torch.rand_like(normal[:, :1])
    cosine = min_cosine + (1.0 - min_cosine) * torch.rand_like(normal[:, :1])
    sine = (1.0 - cosine.square()).clamp_min(0.0).sqrt()
    local = torch.cat([sine * azimuth.cos(), sine * azimuth.sin(), cosine], dim=-1)
    # Not a matmul, which autocast would do in half precision.
    return (local[:, :, None] * local_frame(normal)).sum(1)
