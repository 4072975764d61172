"""Candidate places of lamps, from which a fit chooses, and the lamps that the chosen ones are merged into."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from jaxtyping import Float
from torch import Tensor

from neilfpp_method.fields.lamps import LampPlaces, Lamps
from neilfpp_method.shading.frame import safe_normalize

__all__ = ["FoundLamps", "merge", "propose"]

REACH = 1.25
"""Lamps are sought within this distance of the scene's middle: the object lies in the unit sphere, and what
is much farther away looks the same from all of it.
"""
CLEARANCE = 3.0
"""In radii: lamps are sought at this distance from every surface point and more."""
CLONES = 12
"""Candidates around each lit lamp, so that it can move and turn."""
BULB_SHARE = 1 / 3
"""Share of the candidates that send alike in all directions; the others are panels with an axis."""
AXIS_SPREAD = 0.7
"""Standard deviation added to the direction to the scene's middle, per axis, for the axis of a panel: a lamp
mostly faces what it lights.
"""
MIN_MEAN_AXIS = 0.5
"""Length of the mean axis above which merged candidates make a panel; opposite axes make a bulb."""
MERGE_DISTANCE = 0.2
"""Candidates within this distance, scene units, are merged into one lamp."""
STEP = 0.06
"""Standard deviation of their distance from it, per axis, scene units."""
MIN_LAMP_SHARE = 0.02
"""Share of the light of all lamps below which a lamp is dropped."""


@dataclass(frozen=True)
class FoundLamps:
    """Lamps, those that bring most light first."""

    places: LampPlaces
    intensity: Float[Tensor, "K 3"]


@torch.no_grad()
def propose(lamps: Lamps, surface: Float[Tensor, "N 3"], count: int) -> LampPlaces:
    """Up to `count` places: the lit lamps first and in order, others close to each, and random ones."""
    lit, axis = lamps.position[: lamps.lit], lamps.axis[: lamps.lit]
    moved = lit.repeat_interleave(CLONES, 0)
    moved = moved + STEP * torch.randn_like(moved)
    # Of a cube of random points about half lie in the ball, and fewer are clear of the surface.
    anywhere = REACH * (2 * torch.rand(6 * count, 3, device=surface.device, dtype=surface.dtype) - 1)
    guesses = torch.cat((moved, anywhere[anywhere.norm(dim=-1) < REACH]))
    clear = torch.cdist(guesses, surface).amin(-1) > CLEARANCE * lamps.radius
    guesses = guesses[clear]
    turned = safe_normalize(safe_normalize(-guesses) + AXIS_SPREAD * torch.randn_like(guesses))
    bare = torch.rand_like(guesses[:, :1]) < BULB_SHARE
    return LampPlaces(torch.cat((lit, guesses)), torch.cat((axis, turned.masked_fill(bare, 0.0))))[:count]


@torch.no_grad()
def merge(
    places: LampPlaces, intensity: Float[Tensor, "M 3"], reach: Float[Tensor, " M"], most: int
) -> FoundLamps:
    """Neighbours merged at their middle by power with their joint intensity; weak lamps are left out.

    `reach` is the light that a lamp of intensity 1 brings to the scene: unreachable lamps count nothing.
    """
    power = intensity.sum(-1) * reach
    left = torch.ones_like(power, dtype=torch.bool)
    position, axis = places.position, places.axis
    positions, axes, intensities = [], [], []
    for leader in power.argsort(descending=True).tolist():
        if len(positions) == most or power[leader] <= MIN_LAMP_SHARE * power.sum():
            break
        if left[leader]:
            group = left & ((position - position[leader]).norm(dim=-1) < MERGE_DISTANCE)
            left &= ~group
            share = power[group, None] / power[group].sum()
            positions.append((share * position[group]).sum(0))
            towards = (share * axis[group]).sum(0)
            axes.append(torch.where(towards.norm() > MIN_MEAN_AXIS, safe_normalize(towards), 0.0))
            intensities.append(intensity[group].sum(0))
    if not positions:
        return FoundLamps(places[:0], intensity[:0])
    return FoundLamps(LampPlaces(torch.stack(positions), torch.stack(axes)), torch.stack(intensities))
