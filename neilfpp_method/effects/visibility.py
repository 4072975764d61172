"""Evidence for shadows and light between surfaces: how much of what a surface looks at is the scene itself.

A surface point that sees a share q of its hemisphere blocked, by the cosine, gets a share q of its light from
the scene and not from the light, if that is even; where light comes from one side, a share q of all such
points is in shadow in the mean over the sides. So a mean q is the size of the relative error of leaving both
out. A convex body has none.
"""

from __future__ import annotations

import torch
from jaxtyping import Float
from torch import Tensor

from neilfpp_method.effects.measurement import Measurement, mean_of
from neilfpp_method.incident.scene import off_surface, scene_tracer
from neilfpp_method.model import NeilfModel
from neilfpp_method.settings.types import InterReflectionConfig
from neilfpp_method.shading.sampling import cosine
from neilfpp_method.structures import RayBatch

__all__ = ["WORTH", "blocked_share", "self_visibility"]

WORTH = 0.01
"""Share of the hemisphere below which nothing is traced; lamps must save as much (`lighting.fit`)."""
DIRECTIONS = 16
"""Per point, by the cosine. The standard error is mostly that of the choice of points."""
RAYS_AT_ONCE = 2048
"""Rays that are rendered at once, where the host does not trace; bounds the memory."""


@torch.no_grad()
def self_visibility(
    model: NeilfModel,
    settings: InterReflectionConfig,
    position: Float[Tensor, "N 3"],
    normal: Float[Tensor, "N 3"],
) -> Measurement:
    """The share of the hemisphere of surface points, by the cosine, that the scene itself fills.

    Args:
        model: its host traces, or renders where it does not.
        settings: how, when the effect is on; the model may have it off.
        position, normal: of points that cameras see, scene frame.
    """
    share = blocked_share(model, settings, position, normal) if len(position) else position[:, 0]
    return mean_of(share, "directions of surface points that meet the surface", WORTH)


def blocked_share(
    model: NeilfModel,
    settings: InterReflectionConfig,
    position: Float[Tensor, "N 3"],
    normal: Float[Tensor, "N 3"],
) -> Float[Tensor, " N"]:
    """Of each point."""
    drawn = cosine(normal).draw(DIRECTIONS, True)
    host, hit_share = model.host, model.config.shading.hit_share
    if settings.mode == "hard":
        hit = scene_tracer(host, settings, hit_share)(position, drawn).hit
    else:
        start = position.repeat_interleave(DIRECTIONS, 0)
        up, directions = normal.repeat_interleave(DIRECTIONS, 0), drawn.reshape(-1, 3)
        rays = RayBatch(off_surface(host, start, up, directions, settings.offset), directions)
        parts = [rays[i : i + RAYS_AT_ONCE] for i in range(0, len(rays), RAYS_AT_ONCE)]
        hit = torch.cat([host.render(part).is_hit(hit_share) for part in parts]).view(
            len(position), DIRECTIONS
        )
    return hit.float().mean(1)
