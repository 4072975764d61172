"""Normals for shading: those of a surface's neighbourhood, with its edges kept.

A learned distance field is a little wavy, by the cells of its grid, and a highlight moves twice as far as the
normal that throws it: a ripple of three degrees blurs all that tells a metal from paint. So the normals
around a point are fitted by a plane, robustly: they may turn evenly, as on a ball, and those beyond an edge
do not count (Öztireli, Guennebaud and Gross 2009, "Feature preserving point set surfaces based on non-linear
kernel regression").
"""

from __future__ import annotations

import math
from collections.abc import Callable

import torch
from jaxtyping import Float
from torch import Tensor
from torch.nn import functional

from neilfpp_method.shading.frame import local_frame, safe_normalize

__all__ = ["NEIGHBOURS", "smooth_normals"]

RINGS = ((6, 1 / 3), (10, 2 / 3), (16, 1.0))
"""Neighbours on each ring, and its share of the radius."""
NEIGHBOURS = sum(count for count, _ in RINGS)
UNLIKE = 0.2
"""Distance between two unit normals, 11.5°, at which one counts for 1/√e."""
ROUNDS = 4
"""Of the fit; each weighs the neighbours by what the one before has left over."""
RIDGE = 1e-2
"""Of a neighbour's weight: what ties a slope to 0 where no neighbour says anything."""


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
        radius: of the neighbourhood, scene units. Relief that is finer than this and flatter than `UNLIKE` is
            lost.
    """
    ring = _rings(position)
    around = position[:, None] + radius * (ring @ local_frame(normal)[:, :2])
    seen = torch.cat((normal[:, None], safe_normalize(gradient(around.flatten(0, 1))).view_as(around)), 1)
    # What a plane is linear in: 1 and the place, in units of the radius. The point itself comes first.
    places = functional.pad(torch.cat((torch.zeros_like(ring[:1]), ring)), (1, 0), value=1.0)
    ridge = RIDGE * torch.eye(3).to(ring)
    left_over = seen - normal[:, None]
    for _ in range(ROUNDS):
        weighted = places * torch.exp(-left_over.square().sum(-1, keepdim=True) / (2 * UNLIKE**2))
        # Never singular, by the ridge; `solve` would have the host wait for the device to hear that.
        plane = torch.linalg.solve_ex(weighted.mT @ places + ridge, weighted.mT @ seen).result
        left_over = seen - places @ plane
    return safe_normalize(plane[:, 0])


def _rings(like: Tensor) -> Float[Tensor, "K 2"]:
    """Places in the tangent plane for a radius of 1; each ring is turned against the one before."""
    angles = [
        (torch.arange(count) + 0.5 * number) * (2 * math.pi / count)
        for number, (count, _) in enumerate(RINGS)
    ]
    shares = torch.cat([torch.full((count,), share) for count, share in RINGS])
    angle = torch.cat(angles)
    return (shares * torch.stack((angle.cos(), angle.sin()))).t().to(like)
