"""Light from the scene's own surfaces: rays that start at a surface, traced through the host (METHOD §2)."""

from __future__ import annotations

import torch
from jaxtyping import Float
from torch import Tensor

from neilfpp_method.hosts.base import HasSurfaceWidth, Host, TracesLight
from neilfpp_method.structures import RayBatch, SceneLight, SceneTracer
from neilfpp_method.timing.ledger import timed

__all__ = ["off_surface", "scene_light", "scene_tracer"]

HEIGHT_IN_WIDTHS = 4.0
"""Height above the surface at which a ray starts, in units of the density's scale β. A ray that starts at
height h still crosses the optical depth exp(−h/β) / (2 cos θ): at 4 β that is 1 % along the normal and 5 % at
80°.
"""

MIN_COSINE = 0.1
"""Lower bound on cos θ in the displacement of the start; it matters for rays within 6° of the
surface."""

RAYS_AT_ONCE = 2048
"""Number of rays per batch for a host without cheap tracing; limits memory."""


def scene_tracer(host: Host, offset: float, hit_share: float) -> SceneTracer:
    """`scene_light` of a host, as a function of surface points and directions."""
    return lambda x, wi: scene_light(host, x, wi, offset, hit_share)


@timed("tracing")
@torch.no_grad()
def scene_light(
    host: Host,
    x: Float[Tensor, "N 3"],
    wi: Float[Tensor, "N S 3"],
    offset: float,
    hit_share: float,
) -> SceneLight:
    """Light from the scene's surfaces at surface points, without gradient.

    It uses the host's own tracing (`TracesLight`) if there is one; otherwise it renders all N·S rays.

    Args:
        host: geometry and outgoing radiance.
        x: surface points, scene frame.
        wi: unit directions away from the surface.
        offset: distance from x at which rendered rays start, scene units.
        hit_share: smallest concentration of the rendering weight that counts as a hit.
    """
    x = x.detach()
    if isinstance(host, TracesLight):
        # Half precision is too coarse for the hits, and hosts collect their radiance in float32.
        with torch.autocast(x.device.type, enabled=False):
            return host.scene_light(x, wi)
    points = x[:, None].expand_as(wi).reshape(-1, 3)
    radiance, distance = [], []
    for point, direction in zip(
        points.split(RAYS_AT_ONCE), wi.reshape(-1, 3).split(RAYS_AT_ONCE), strict=True
    ):
        hits = host.render(RayBatch(point + offset * direction, direction))
        hit = hits.is_hit(hit_share)
        distance.append(torch.where(hit, (hits.position - point).norm(dim=-1), torch.inf))
        radiance.append(torch.where(hit[:, None], hits.color, 0.0))
    distance = torch.cat(distance).view(wi.shape[:2])
    return SceneLight(distance.isfinite(), torch.cat(radiance).view(wi.shape), distance)


def off_surface(
    host: Host, x: Float[Tensor, "K 3"], normal: Float[Tensor, "K 3"], w: Float[Tensor, "K 3"], offset: float
) -> Float[Tensor, "K 3"]:
    """Move points along w to a height of `offset` + 4 β above the surface, β the width of its soft layer."""
    width = host.surface_width() if isinstance(host, HasSurfaceWidth) else 0.0
    cosine = (w * normal).sum(-1, keepdim=True).clamp_min(MIN_COSINE)
    return x + ((offset + HEIGHT_IN_WIDTHS * width) / cosine) * w
