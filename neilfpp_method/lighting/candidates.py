"""Propose candidate lamps for a fit, and merge the candidates that the fit makes bright into a few lamps."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from jaxtyping import Float
from torch import Tensor

from neilfpp_method.fields.lamps import LampPlaces, Lamps
from neilfpp_method.shading.frame import safe_normalize

__all__ = ["FoundLamps", "merge_lamps", "propose"]

MAX_RADIUS = 1.25
"""Largest distance of a candidate from the scene's centre, in scene units. The object lies in the unit
sphere, and a light that is much farther away looks the same from every point of it.
"""
CLEARANCE = 3.0
"""Smallest distance of a candidate from any surface point, in lamp radii."""
CLONES = 12
"""Number of candidates around each existing lamp, which let it move and turn."""
BULB_SHARE = 1 / 3
"""Share of the candidates that are bulbs, which radiate evenly; the others are panels with an axis."""
AXIS_SPREAD = 0.7
"""Standard deviation, per component, of the random offset that is added to the unit direction towards the
scene's centre to give the axis of a candidate panel: most lamps face what they light.
"""
MIN_MEAN_AXIS = 0.5
"""Merged candidates become a panel if their mean axis is longer than this, otherwise a bulb."""
MERGE_DISTANCE = 0.2
"""Candidates within this distance of a stronger one are merged with it, in scene units."""
CLONE_OFFSET = 0.06
"""Standard deviation of the offset of a clone from its lamp, per axis, in scene units."""
MIN_LAMP_SHARE = 0.02
"""A lamp with less than this share of the light of all lamps is dropped."""


@dataclass(frozen=True)
class FoundLamps:
    """K lamps in order of the light that they bring to the scene, the strongest first.

    Attributes:
        places: their positions and axes.
        intensity: their radiant intensities.
    """

    places: LampPlaces
    intensity: Float[Tensor, "K 3"]


@torch.no_grad()
def propose(lamps: Lamps, surface: Float[Tensor, "N 3"], count: int) -> LampPlaces:
    """Propose candidate lamps.

    Args:
        lamps: the lamps of the model; those that are lit become candidates.
        surface: surface points, which candidates keep clear of.
        count: maximum number of candidates.

    Returns:
        At most `count` places: the lit lamps in their order, then random places near each of them, then
        random places in the whole scene.
    """
    lit = lamps.lit_places
    moved = lit.position.repeat_interleave(CLONES, 0)
    moved = moved + CLONE_OFFSET * torch.randn_like(moved)
    # About half of the points of a cube lie in its ball, and some of those are too close to the surface.
    anywhere = MAX_RADIUS * (2 * torch.rand(6 * count, 3, device=surface.device, dtype=surface.dtype) - 1)
    guesses = torch.cat((moved, anywhere[anywhere.norm(dim=-1) < MAX_RADIUS]))
    clear = torch.cdist(guesses, surface).amin(-1) > CLEARANCE * lamps.radius
    guesses = guesses[clear]
    turned = safe_normalize(safe_normalize(-guesses) + AXIS_SPREAD * torch.randn_like(guesses))
    is_bulb = torch.rand_like(guesses[:, :1]) < BULB_SHARE
    axes = torch.cat((lit.axis, turned.masked_fill(is_bulb, 0.0)))
    return LampPlaces(torch.cat((lit.position, guesses)), axes)[:count]


@torch.no_grad()
def merge_lamps(
    places: LampPlaces, intensity: Float[Tensor, "M 3"], reach: Float[Tensor, " M"], max_lamps: int
) -> FoundLamps:
    """Merge neighbouring lamps and drop weak ones.

    A merged lamp has the mean position and axis of its parts, weighted by their power, and the sum of their
    intensities.

    Args:
        places: positions and axes of the M lamps.
        intensity: their intensities.
        reach: mean contribution of each lamp, at intensity 1, to the scene; 0 if it is hidden from every
            surface point. The power of a lamp is its intensity times this.
        max_lamps: maximum number of lamps to return.

    Returns:
        The merged lamps, the strongest first.
    """
    power = intensity.sum(-1) * reach
    remaining = torch.ones_like(power, dtype=torch.bool)
    position, axis = places.position, places.axis
    positions, axes, intensities = [], [], []
    for leader in power.argsort(descending=True).tolist():
        if len(positions) == max_lamps or power[leader] <= MIN_LAMP_SHARE * power.sum():
            break
        if remaining[leader]:
            group = remaining & ((position - position[leader]).norm(dim=-1) < MERGE_DISTANCE)
            remaining &= ~group
            share = power[group, None] / power[group].sum()
            positions.append((share * position[group]).sum(0))
            mean_axis = (share * axis[group]).sum(0)
            axes.append(torch.where(mean_axis.norm() > MIN_MEAN_AXIS, safe_normalize(mean_axis), 0.0))
            intensities.append(intensity[group].sum(0))
    if not positions:
        return FoundLamps(places[:0], intensity[:0])
    return FoundLamps(LampPlaces(torch.stack(positions), torch.stack(axes)), torch.stack(intensities))
