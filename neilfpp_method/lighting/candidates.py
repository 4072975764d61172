"""Where lamps might be: guesses for a fit to choose from, and what the chosen ones come down to."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from jaxtyping import Float
from torch import Tensor

from neilfpp_method.fields.lamps import LampPlaces, Lamps
from neilfpp_method.shading.frame import safe_normalize

__all__ = ["FoundLamps", "merge", "propose"]

REACH = 1.25
"""Lamps are sought within this distance of the scene's middle: the object lies in the unit sphere, and what is much farther
away looks the same from all of it."""
CLEARANCE = 3.0
"""In radii: lamps are sought at this distance from every surface point and more."""
CLONES = 12
"""Guesses around each lamp that is lit, so that it can move and turn."""
BARE_SHARE = 1 / 3
"""Of the guesses: those that send alike in all directions."""
SPREAD = 0.7
"""Of the axes of the others about the direction to the scene's middle: a lamp is mostly turned to what it lights."""
UNANIMOUS = 0.5
"""Mean of the axes of lamps that are one, above which it has an axis: opposite ones make a bulb."""
TOGETHER = 0.2
"""Lamps within this distance, scene units, are one."""
STEP = 0.06
"""Scale of the distance, per axis, of the guesses around a lamp."""
LEAST_SHARE = 0.02
"""Of the light that all lamps bring; what brings less is none."""


@dataclass(frozen=True)
class FoundLamps:
    """Lamps, those that bring most light first."""

    places: LampPlaces
    intensity: Float[Tensor, "K 3"]


@torch.no_grad()
def propose(lamps: Lamps, surface: Float[Tensor, "N 3"], count: int) -> LampPlaces:
    """Up to `count` places: the lit lamps as they are, first and in order, others close to each, and the rest anywhere."""
    lit, axis = lamps.position[: lamps.lit], lamps.axis[: lamps.lit]
    moved = lit.repeat_interleave(CLONES, 0)
    moved = moved + STEP * torch.randn_like(moved)
    # Of a cube of random points about half lie in the ball, and fewer are clear of the surface.
    anywhere = REACH * (2 * torch.rand(6 * count, 3, device=surface.device, dtype=surface.dtype) - 1)
    guesses = torch.cat((moved, anywhere[anywhere.norm(dim=-1) < REACH]))
    clear = torch.cdist(guesses, surface).amin(-1) > CLEARANCE * lamps.radius
    guesses = guesses[clear]
    turned = safe_normalize(safe_normalize(-guesses) + SPREAD * torch.randn_like(guesses))
    bare = torch.rand_like(guesses[:, :1]) < BARE_SHARE
    return LampPlaces(torch.cat((lit, guesses)), torch.cat((axis, turned.masked_fill(bare, 0.0))))[:count]


@torch.no_grad()
def merge(places: LampPlaces, intensity: Float[Tensor, "M 3"], reach: Float[Tensor, " M"], most: int) -> FoundLamps:
    """Neighbours made one, in their middle by power and of their joint intensity; those that bring little are left out.

    `reach` is the light that a lamp of intensity 1 brings to the scene: a strong one that reaches nothing counts for nothing.
    """
    power = intensity.sum(-1) * reach
    left = torch.ones_like(power, dtype=torch.bool)
    position, axis = places.position, places.axis
    positions, axes, intensities = [], [], []
    for leader in power.argsort(descending=True).tolist():
        if len(positions) == most or power[leader] <= LEAST_SHARE * power.sum():
            break
        if left[leader]:
            group = left & ((position - position[leader]).norm(dim=-1) < TOGETHER)
            left &= ~group
            share = power[group, None] / power[group].sum()
            positions.append((share * position[group]).sum(0))
            towards = (share * axis[group]).sum(0)
            axes.append(torch.where(towards.norm() > UNANIMOUS, safe_normalize(towards), 0.0))
            intensities.append(intensity[group].sum(0))
    if not positions:
        return FoundLamps(places[:0], intensity[:0])
    return FoundLamps(LampPlaces(torch.stack(positions), torch.stack(axes)), torch.stack(intensities))
