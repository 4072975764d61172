"""Light between surfaces (METHOD §2): which rays are traced, and what they bring back."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from neilfpp_method.hosts.base import HasSurfaceWidth, Host, KnowsMisses, LightsItself
from neilfpp_method.losses import scale_gradient
from neilfpp_method.settings.types import InterReflectionConfig
from neilfpp_method.shading.frame import local_frame
from neilfpp_method.structures import RayBatch, SceneLight

__all__ = ["TracedLight", "before_light", "off_surface", "scene_light", "trace_light"]

# A layer of scale β still absorbs along a ray that leaves it: from a height h, the optical depth is exp(−h/β) / (2 cos θ).
# Four scales up it is 1 % along the normal and 5 % at 80°.
HEIGHT_IN_WIDTHS = 4.0

# The furthest from its point that a ray of L_ref may start, scene units (published code). Further out it could start behind
# a neighbouring surface, and nearer than its angle asks for it would meet the layer that it leaves: it is left out.
FARTHEST_START = 0.2

# Rays that a host without cheap tracing renders at once: what bounds the memory.
MOST_RENDERED = 2048


Light = Callable[[Float[Tensor, "N 3"], Float[Tensor, "N S 3"]], Float[Tensor, "N S 3"]]
"""What would arrive at surface points if nothing were in the way."""


@dataclass(frozen=True)
class TracedLight:
    """Rays that left the surface: where from, which way, the radiance that arrives along them, and which ones hit.

    Rays of which the host knows at once that they meet nothing, and those that cannot leave its layer, are left out.
    """

    position: Float[Tensor, "K 3"]
    wi: Float[Tensor, "K 3"]
    radiance: Float[Tensor, "K 3"]
    hit: Bool[Tensor, " K"]


def trace_light(
    host: Host,
    position: Float[Tensor, "N 3"],
    normal: Float[Tensor, "N 3"],
    config: InterReflectionConfig,
    hit_share: float,
) -> TracedLight:
    """Trace random directions from random points through the host.

    Directions are uniform in solid angle within `config.max_angle_deg` of the normal. A ray starts off the surface: at a
    height of `config.offset` and four widths of the host's surface, so the displacement along the ray grows as 1/cos.
    A ray that would have to start further than `FARTHEST_START` from its point is left out.
    Positions are constants: L_ref says what arrives at a point, not where the point is.

    Args:
        host: renders the rays; its radiance gets a gradient scaled by `config.radiance_gradient`, none when that is 0.
        position: surface points, scene frame.
        normal: unit normals, away from the surface.
        config: how many, how far, how steep.
        hit_share: least concentration of a hit.
    """
    position, normal = position.detach(), normal.detach()
    rows = _random_rows(position.shape[0], config.rays_per_point, position.device)
    position, normal = position[rows], normal[rows]
    wi = _cone_directions(normal, math.cos(math.radians(config.max_angle_deg)))
    start = off_surface(host, position, normal, wi, config.offset)
    worth = (start - position).norm(dim=-1) <= FARTHEST_START
    if isinstance(host, KnowsMisses):
        worth &= host.may_meet(RayBatch(start, wi))
    rows = torch.nonzero(worth)[:, 0]
    position, start, wi = position[rows], start[rows], wi[rows]
    with torch.set_grad_enabled(torch.is_grad_enabled() and config.radiance_gradient > 0.0):
        hits = host.render(RayBatch(start, wi))
    radiance = scale_gradient(hits.color, config.radiance_gradient)
    return TracedLight(position, wi, radiance, hits.is_hit(hit_share))


@torch.no_grad()
def scene_light(
    host: Host,
    x: Float[Tensor, "N 3"],
    wi: Float[Tensor, "N S 3"],
    config: InterReflectionConfig,
    hit_share: float,
) -> SceneLight:
    """What the scene itself sends to surface points: by the host's own tracing, or by rendering all N·S rays."""
    x = x.detach()
    if isinstance(host, LightsItself):
        return host.scene_light(x, wi)
    start = (x[:, None] + config.offset * wi).reshape(-1, 3)
    radiance, distance = [], []
    for origins, directions in zip(start.split(MOST_RENDERED), wi.reshape(-1, 3).split(MOST_RENDERED), strict=True):
        hits = host.render(RayBatch(origins, directions))
        hit = hits.is_hit(hit_share)
        distance.append(torch.where(hit, (hits.position - origins).norm(dim=-1), torch.inf))
        radiance.append(torch.where(hit[:, None], hits.color, 0.0))
    distance = torch.cat(distance).view(wi.shape[:2])
    return SceneLight(distance.isfinite(), torch.cat(radiance).view(wi.shape), distance)


def off_surface(
    host: Host, x: Float[Tensor, "K 3"], normal: Float[Tensor, "K 3"], w: Float[Tensor, "K 3"], offset: float
) -> Float[Tensor, "K 3"]:
    """Points along w beyond the layer that a host's surface is, at a height of `offset` and four widths of it.

    Directions along the surface count as if they left it at 6°.
    """
    width = host.surface_width() if isinstance(host, HasSurfaceWidth) else 0.0
    cosine = (w * normal).sum(-1, keepdim=True).clamp_min(0.1)
    return x + ((offset + HEIGHT_IN_WIDTHS * width) / cosine) * w


def before_light(
    scene: SceneLight, light: Light, x: Float[Tensor, "N 3"], wi: Float[Tensor, "N S 3"]
) -> Float[Tensor, "N S 3"]:
    """Hard inter-reflection: what the scene sends, and where it is not in the way the light, which is asked there alone."""
    point, direction = torch.nonzero(~scene.hit, as_tuple=True)
    behind = light(x[point], wi[point, direction][:, None])[:, 0]
    return scene.radiance.index_put((point, direction), behind)


def _random_rows(points: int, per_point: float, device: torch.device) -> Tensor:
    """Rows of the points that send a ray: every point ⌊per_point⌋ times, and a random choice for the rest."""
    whole = int(per_point)
    rest = round(points * (per_point - whole))
    return torch.cat([torch.arange(points, device=device).repeat(whole), torch.randperm(points, device=device)[:rest]])


def _cone_directions(normal: Float[Tensor, "K 3"], least: float) -> Float[Tensor, "K 3"]:
    """Directions uniform in the cone cos θ ≥ `least` about the normal."""
    azimuth = 2.0 * math.pi * torch.rand_like(normal[:, :1])
    cosine = least + (1.0 - least) * torch.rand_like(normal[:, :1])
    sine = (1.0 - cosine.square()).clamp_min(0.0).sqrt()
    local = torch.cat([sine * azimuth.cos(), sine * azimuth.sin(), cosine], dim=-1)
    return (local[:, None] @ local_frame(normal))[:, 0]
