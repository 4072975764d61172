"""Refine the positions, axes and intensities of lamps by gradient descent, and drop superfluous lamps.

No candidate lies exactly on a lamp, so a fit represents a lamp by several candidates around it, which
together are too strong. Choosing candidates and refining their places alternate from fit to fit: this is a
conditional gradient method with moving atoms (Boyd, Schiebinger and Recht 2017, "The alternating descent
conditional gradient method for sparse inverse problems").
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from neilfpp_method.fields.lamps import LampPlaces
from neilfpp_method.lighting.candidates import FoundLamps
from neilfpp_method.lighting.descent import Unknown, descend
from neilfpp_method.lighting.fit import MIN_REACH
from neilfpp_method.lighting.fit_points import FitPoints
from neilfpp_method.lighting.objective import Objective, Target
from neilfpp_method.lighting.transport import Transport
from neilfpp_method.shading.frame import safe_normalize

__all__ = ["settle_lamps"]

STEPS = 100
"""Adam steps of one descent."""
RATE = 0.02
"""Initial learning rate of positions, in scene units."""
AXIS_RATE = 0.06
"""Initial learning rate of axes and of the logarithms of intensity."""
GAIN_RATE = 0.1
"""Initial learning rate of the logarithms of the factors on base colour."""
PANEL_GAIN = 0.01
"""A lamp is a panel rather than a bulb only if that lowers the loss by more than this share: the additional
unknowns of the axis always lower it a little.
"""
FAINT_SHARE = 1e-3
"""Intensities are raised to at least this share of the strongest one before their logarithm is taken: the
logarithm of 0 cannot be optimised.
"""


@dataclass(frozen=True)
class _Settled:
    """Refined lamps and their loss; it is infinite if the descent failed."""

    lamps: FoundLamps
    loss: float


@torch.no_grad()
def settle_lamps(
    initial: FoundLamps,
    radius: float,
    beside: Transport,
    points: FitPoints,
    objective: Objective,
) -> FoundLamps:
    """Refine lamps and drop superfluous ones.

    First all lamps are refined together. Then each lamp, from the weakest to the strongest, is dropped if
    the loss is lower without it, after its power is given to the nearest other lamp and the rest is refined
    again. Finally each remaining lamp is tried as a panel and as a bulb, because a panel at one place looks
    much like a bulb at another. A lamp that hardly reaches any point is dropped: nothing determines it.

    Args:
        initial: initial lamps, the strongest first.
        radius: radius of every lamp, in scene units.
        beside: transport of all other light, as constant radiance (it has no sources).
        points: the surface points.
        objective: the terms of the loss and their weights.

    Returns:
        The refined lamps; `initial` if there are no points or the descent is not finite.
    """
    if not len(points.observed):
        return initial
    target, position = points.target, points.observed.position

    def loss_of(
        lamps: FoundLamps, sight: Bool[Tensor, "N M"], gain: Float[Tensor, "#N 3"]
    ) -> Float[Tensor, ""]:
        kernel = points.lamp_kernel(lamps.places, radius, sight)
        contribution = kernel[0].mean(0)[:, None] * lamps.intensity
        all_light = contribution.sum(0) + beside.scene[0].mean(0)
        misfit = objective.misfit(lamps.intensity, Transport(kernel, beside.scene), target, gain)
        return misfit + objective.lamp_prior(contribution.mean(-1), all_light)

    def settle(lamps: FoundLamps) -> _Settled:
        # Visibility is not differentiated: it is computed once per descent, at the initial positions.
        sight = points.in_sight(lamps.places, radius)
        return _descend(lamps, target, objective, lambda moved, gain: loss_of(moved, sight, gain))

    def reaching(lamps: FoundLamps) -> FoundLamps:
        kernel = points.lamp_kernel(lamps.places, radius, points.in_sight(lamps.places, radius))
        reach = kernel[0].mean(0)
        keep = reach > MIN_REACH * reach.mean()
        return FoundLamps(lamps.places[keep], lamps.intensity[keep])

    initial = reaching(initial)
    if not len(initial.intensity):
        return initial
    best = settle(initial)
    if not math.isfinite(best.loss):
        return initial
    for number in reversed(range(len(initial.intensity))):
        if len(best.lamps.intensity) == 1:
            break
        without = settle(_without(best.lamps, number))
        if without.loss < best.loss:
            best = without
    for number in range(len(best.lamps.intensity)):
        other = settle(_of_other_kind(best.lamps, number, position))
        is_panel = best.lamps.places.axis[number].any()
        panel, bulb = (best, other) if is_panel else (other, best)
        best = panel if panel.loss < (1 - PANEL_GAIN) * bulb.loss else bulb
    return reaching(settle(best.lamps).lamps)


def _of_other_kind(lamps: FoundLamps, number: int, points: Float[Tensor, "N 3"]) -> FoundLamps:
    """The same lamps with one panel made a bulb, or one bulb made a panel that faces the points."""
    position, axis = lamps.places.position[number], lamps.places.axis.clone()
    to_points = safe_normalize((points - position).mean(0, keepdim=True))[0]
    axis[number] = torch.where(axis[number].any(), 0.0, to_points)
    return FoundLamps(LampPlaces(lamps.places.position, axis), lamps.intensity)


def _without(lamps: FoundLamps, number: int) -> FoundLamps:
    """All lamps except one, whose intensity is added to that of the nearest other lamp."""
    others = torch.arange(len(lamps.intensity), device=lamps.intensity.device) != number
    places, intensity = lamps.places[others], lamps.intensity[others]
    nearest = (places.position - lamps.places.position[number]).norm(dim=-1).argmin()
    intensity[nearest] += lamps.intensity[number]
    return FoundLamps(places, intensity)


def _descend(
    start: FoundLamps,
    target: Target,
    objective: Objective,
    loss_of: Callable[[FoundLamps, Float[Tensor, "#N 3"]], Float[Tensor, ""]],
) -> _Settled:
    """Minimise a loss over position, axis and intensity; return `start` if the result is not finite."""
    is_bulb = start.places.axis.square().sum(-1, keepdim=True) == 0
    position = start.places.position.clone().requires_grad_()
    axis = start.places.axis.clone().requires_grad_()
    log_intensity = start.intensity.clamp_min(FAINT_SHARE * start.intensity.max()).log().requires_grad_()

    def lamps() -> FoundLamps:
        return FoundLamps(
            LampPlaces(position, safe_normalize(axis).masked_fill(is_bulb, 0.0)), log_intensity.exp()
        )

    unknowns = (Unknown(position, RATE), Unknown(axis, AXIS_RATE), Unknown(log_intensity, AXIS_RATE))
    loss = descend(unknowns, GAIN_RATE, STEPS, target, objective, lambda gain: loss_of(lamps(), gain)).loss
    settled = lamps()
    settled = FoundLamps(settled.places.detach(), settled.intensity.detach())
    values = torch.cat((settled.places.position, settled.places.axis, settled.intensity))
    finite = math.isfinite(loss) and values.isfinite().all()
    return _Settled(settled, loss) if finite else _Settled(start, math.inf)
