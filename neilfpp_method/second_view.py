"""A second look at surface points, along the directions of other cameras: what highlights change, and nothing else does."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from jaxtyping import Float, Int
from torch import Tensor

from neilfpp_method.hosts.base import Host
from neilfpp_method.inter_reflection import off_surface
from neilfpp_method.lighting.memory import Observed
from neilfpp_method.shading.brdf import Lobe, cosines
from neilfpp_method.structures import Indexable, RayBatch

__all__ = ["SecondView", "lobe_difference", "second_view"]

SHARE = 0.25
"""Of the points of a step, those that are looked at again: each is rendered and shaded once more."""
LEAST_COSINE = 0.17
"""Views within 10° of the horizon see edges."""
NEARBY = 0.05
"""A ray that ends further from its point, in scene units, has met something else."""


@dataclass(frozen=True)
class SecondView(Indexable):
    """Points that were looked at again: their rows, the direction to the second viewer, and R towards it."""

    row: Int[Tensor, " K"]
    wo: Float[Tensor, "K 3"]
    radiance: Float[Tensor, "K 3"]


@torch.no_grad()
def second_view(host: Host, seen: Observed, offset: float, hit_share: float) -> SecondView:
    """Look at a random share of surface points the way other points of the step are looked at.

    A ray starts close before its point (`off_surface`), so that nothing else is in between. Where no camera has looked that
    way, R has to know from the others.

    Args:
        host: renders the rays; radiance is linear, positions and directions are those of the scene frame.
        seen: surface points, each with the direction to its camera.
        offset: least distance off the surface, scene units.
        hit_share: least concentration of a hit.
    """
    row = torch.randperm(len(seen), device=seen.position.device)[: round(SHARE * len(seen))]
    wo = seen.wo[torch.randint(max(len(seen), 1), row.shape, device=row.device)]
    faces = torch.nonzero((seen.normal[row] * wo).sum(-1) > LEAST_COSINE)[:, 0]
    row, wo = row[faces], wo[faces]
    start = off_surface(host, seen.position[row], seen.normal[row], wo, offset)
    hits = host.render(RayBatch(start, -wo))
    same = hits.is_hit(hit_share) & ((hits.position - seen.position[row]).norm(dim=-1) < NEARBY)
    return SecondView(row, wo, hits.color)[torch.nonzero(same)[:, 0]]


@torch.no_grad()
def lobe_difference(
    lobe: Lobe,
    roughness: Float[Tensor, "K 1"],
    n: Float[Tensor, "K 3"],
    wo: Float[Tensor, "K 3"],
    other: Float[Tensor, "K 3"],
) -> Float[Tensor, "K 1"]:
    """How far the lobe of one view is from the peak of another's, from 0 (no difference) to 1.

    1 − D(n·h) / D(1), where h lies between the mirror direction of `wo` and `other`: a smooth surface shows different light to
    views a few degrees apart, a rough one hardly. All vectors are unit and point away from the surface.
    """
    mirror = 2 * (n * wo).sum(-1, keepdim=True) * n - wo
    cosine = cosines(n, other, mirror[:, None]).h.clamp_min(0)
    return 1 - lobe.distribution(cosine, roughness) / lobe.distribution(torch.ones_like(cosine), roughness)
