"""Where lamps might be: guesses for a fit to choose from, and what the chosen ones come down to."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from jaxtyping import Float
from torch import Tensor

from neilfpp_method.fields.lamps import Lamps

__all__ = ["FoundLamps", "merge", "propose"]

REACH = 1.25
"""Lamps are sought within this distance of the scene's middle: the object lies in the unit sphere, and what is much farther
away looks the same from all of it."""
CLEARANCE = 3.0
"""In radii: lamps are sought at this distance from every surface point and more."""
CLONES = 8
"""Guesses around each lamp that is lit, so that it can move."""
TOGETHER = 0.2
"""Lamps within this distance, scene units, are one."""
STEP = 0.06
"""Scale of the distance, per axis, of the guesses around a lamp."""
LEAST_SHARE = 0.02
"""Of the light that all lamps bring; what brings less is none."""


@dataclass(frozen=True)
class FoundLamps:
    """Lamps, those that bring most light first."""

    position: Float[Tensor, "K 3"]
    intensity: Float[Tensor, "K 3"]


@torch.no_grad()
def propose(lamps: Lamps, surface: Float[Tensor, "N 3"], count: int) -> Float[Tensor, "M 3"]:
    """Up to `count` positions: the lit lamps as they are, first and in order, others close to each, and the rest anywhere."""
    lit = lamps.position[: lamps.lit]
    moved = lit.repeat_interleave(CLONES, 0)
    moved = moved + STEP * torch.randn_like(moved)
    # Of a cube of random points about half lie in the ball, and fewer are clear of the surface.
    anywhere = REACH * (2 * torch.rand(6 * count, 3, device=surface.device, dtype=surface.dtype) - 1)
    guesses = torch.cat((moved, anywhere[anywhere.norm(dim=-1) < REACH]))
    clear = torch.cdist(guesses, surface).amin(-1) > CLEARANCE * lamps.radius
    return torch.cat((lit, guesses[clear]))[:count]


@torch.no_grad()
def merge(
    position: Float[Tensor, "M 3"], intensity: Float[Tensor, "M 3"], reach: Float[Tensor, " M"], most: int
) -> FoundLamps:
    """Neighbours made one, in their middle by power and of their joint intensity; those that bring little are left out.

    `reach` is the light that a lamp of intensity 1 brings to the scene: a strong one that reaches nothing counts for nothing.
    """
    power = intensity.sum(-1) * reach
    left = torch.ones_like(power, dtype=torch.bool)
    positions, intensities = [], []
    for leader in power.argsort(descending=True).tolist():
        if len(positions) == most or power[leader] <= LEAST_SHARE * power.sum():
            break
        if left[leader]:
            group = left & ((position - position[leader]).norm(dim=-1) < TOGETHER)
            left &= ~group
            positions.append((power[group, None] * position[group]).sum(0) / power[group].sum())
            intensities.append(intensity[group].sum(0))
    if not positions:
        return FoundLamps(position[:0], intensity[:0])
    return FoundLamps(torch.stack(positions), torch.stack(intensities))
