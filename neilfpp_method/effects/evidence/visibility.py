"""Evidence for shadows and inter-reflection: the share of the hemisphere that the scene itself occludes.

If a cosine-weighted share q of the hemisphere of a point is occluded, then under an even light a share q of
its irradiance is missing or comes from other surfaces. Under light from a single direction, the probability
that the point is in shadow is q on average over the directions. The mean q is therefore the relative error
of leaving out shadows and inter-reflection. It is 0 for a convex body.
"""

from __future__ import annotations

import torch
from jaxtyping import Float
from torch import Tensor

from neilfpp_method.effects.measurement import Measurement, mean_of
from neilfpp_method.incident.scene import off_surface, scene_tracer
from neilfpp_method.model import NeilfModel
from neilfpp_method.settings.types import NeilfConfig
from neilfpp_method.shading.sampling import cosine
from neilfpp_method.structures import RayBatch

__all__ = ["THRESHOLD", "blocked_share", "self_visibility"]

THRESHOLD = 0.01
"""Mean occluded share above which shadows and inter-reflection are simulated. It equals the threshold for
lamps (`lighting.fit.MIN_GAIN`).
"""
DIRECTIONS = 16
"""Cosine-distributed directions per point. More would not reduce the standard error much, because it is
dominated by the choice of points.
"""
RAYS_AT_ONCE = 2048
"""Maximum number of rays that are rendered at once if the host cannot trace; it bounds memory."""


@torch.no_grad()
def self_visibility(
    model: NeilfModel,
    settings: NeilfConfig,
    position: Float[Tensor, "N 3"],
    normal: Float[Tensor, "N 3"],
) -> Measurement:
    """Measure the cosine-weighted share of the hemisphere that the scene itself occludes.

    Args:
        model: its host traces the rays, or renders them if it cannot trace.
        settings: the settings under which rays are traced; the model's may have inter-reflection off.
        position: surface points that cameras see, scene frame.
        normal: unit normals at these points.
    """
    share = blocked_share(model, settings, position, normal) if len(position) else position[:, 0]
    return mean_of(share, "directions of surface points that the scene occludes", THRESHOLD)


def blocked_share(
    model: NeilfModel,
    settings: NeilfConfig,
    position: Float[Tensor, "N 3"],
    normal: Float[Tensor, "N 3"],
) -> Float[Tensor, " N"]:
    """The occluded share of the hemisphere of each point. Arguments as in `self_visibility`."""
    drawn = cosine(normal).draw(DIRECTIONS, True)
    host, hit_share = model.host, model.config.shading.hit_share
    if settings.light.inter_reflection == "hard":
        hit = scene_tracer(host, settings.ray_offset, hit_share)(position, drawn).hit
    else:
        start = position.repeat_interleave(DIRECTIONS, 0)
        up, directions = normal.repeat_interleave(DIRECTIONS, 0), drawn.reshape(-1, 3)
        rays = RayBatch(off_surface(host, start, up, directions, settings.ray_offset), directions)
        parts = [rays[i : i + RAYS_AT_ONCE] for i in range(0, len(rays), RAYS_AT_ONCE)]
        hit = torch.cat([host.render(part).is_hit(hit_share) for part in parts])
        hit = hit.view(len(position), DIRECTIONS)
    return hit.float().mean(1)
