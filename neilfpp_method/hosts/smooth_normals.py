"""Normals for shading: those of a surface's neighbourhood, with its edges kept.

A learned distance field is a little wavy, by the cells of its grid, and a highlight moves twice as far as the normal that
throws it: a ripple of three degrees blurs all that tells a metal from paint. Normals around a point are averaged, the more
alike the more they count (bilateral filtering; of normals: Zheng et al. 2011, "Bilateral normal filtering for mesh denoising").
In the tangent plane a ring about a point takes nothing from a sphere, a cylinder or a saddle.
"""

from __future__ import annotations

import math
from collections.abc import Callable

import torch
from jaxtyping import Float
from torch import Tensor

from neilfpp_method.shading.frame import local_frame, safe_normalize

__all__ = ["NEIGHBOURS", "smooth_normals"]

RINGS = ((6, 1 / 3), (10, 2 / 3), (16, 1.0))
"""Neighbours on each ring, and its share of the radius."""
NEIGHBOURS = sum(count for count, _ in RINGS)
UNLIKE = 0.02
"""1 − cos of the angle (11.5°) at which a neighbour counts for 1/e."""
ROUNDS = 3
"""Each round compares the neighbours with what the one before has found."""


@torch.no_grad()
def smooth_normals(
    gradient: Callable[[Float[Tensor, "P 3"]], Float[Tensor, "P 3"]],
    position: Float[Tensor, "N 3"],
    normal: Float[Tensor, "N 3"],
    radius: float,
) -> Float[Tensor, "N 3"]:
    """Unit normals of the surface around points.

    Args:
        gradient: of the signed distance; asked at `NEIGHBOURS` places about each point.
        position: points on the surface, scene frame.
        normal: their unit normals, as noisy as they are.
        radius: of the neighbourhood, scene units. Relief that is finer than this and flatter than `UNLIKE` is lost.
    """
    around = (_rings(position) * radius) @ local_frame(normal)
    others = safe_normalize(gradient((position[:, None] + around).flatten(0, 1))).view_as(around)
    found = normal
    for _ in range(ROUNDS):
        unlike = 1 - (others * found[:, None]).sum(-1, keepdim=True)
        found = safe_normalize(normal + (others * torch.exp(-unlike / UNLIKE)).sum(1))
    return found


def _rings(like: Tensor) -> Float[Tensor, "K 3"]:
    """Places in the tangent plane for a radius of 1; each ring is turned against the one before."""
    angles = [(torch.arange(count) + 0.5 * number) * (2 * math.pi / count) for number, (count, _) in enumerate(RINGS)]
    shares = torch.cat([torch.full((count,), share) for count, share in RINGS])
    angle = torch.cat(angles)
    return torch.stack((shares * angle.cos(), shares * angle.sin(), torch.zeros_like(angle)), -1).to(like)
