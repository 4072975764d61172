"""Refine found lamps: their places, axes and intensities by descent, and drop those that are not needed.

Candidates lie beside a lamp, never on it, so a fit finds a lamp in pieces: several candidates around it, too
strong together. Their places are refined by descent, in turns with the choice of candidates: conditional
gradients with moving atoms (Boyd, Schiebinger and Recht 2017, "The alternating descent conditional gradient
method for sparse inverse problems").
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
from neilfpp_method.lighting.objective import Objective, Target
from neilfpp_method.lighting.transport import Transport, in_sight, lamp_kernel
from neilfpp_method.shading.brdf import Lobe
from neilfpp_method.shading.frame import safe_normalize
from neilfpp_method.structures import Observed, SceneTracer

__all__ = ["settle_lamps"]

STEPS = 100
RATE = 0.02
"""Scene units per step, at the start."""
AXIS_RATE = 0.06
"""Per step, at the start, of axes and of logarithms of intensity."""
GAIN_RATE = 0.1
"""Per step, at the start, of the logarithms of the factors on base colour."""
PANEL_GAIN = 0.01
"""Share of the loss that a panel must save over a bulb: its axis alone lowers the loss a little."""
FAINT_SHARE = 1e-3
"""Share of the strongest channel to which darker ones are raised first: the logarithm needs a slope."""


@dataclass(frozen=True)
class _Settled:
    lamps: FoundLamps
    loss: float


@torch.no_grad()
def settle_lamps(
    found: FoundLamps,
    radius: float,
    beside: Transport,
    observed: Observed,
    target: Target,
    lobe: Lobe | None,
    scene: SceneTracer | None,
    objective: Objective,
) -> FoundLamps:
    """Lamps whose places, axes and intensities minimise the objective, and as few of them as do.

    From the weakest to the strongest, a lamp is dropped where the others, its power given to its neighbour,
    have a lower loss. Each lamp that is left is tried as a panel and as a bulb, as one at another place looks
    much like the other.

    Args:
        found: lamps to start from, the strongest first.
        radius: of each, scene units.
        beside: all other light, with no sources of its own.
        observed, target: the points, and what they look like.
        lobe, scene: as of `from_texels`.
        objective: what is minimised.
    """
    if not len(found.intensity) or not len(observed):
        return found

    def loss_of(
        lamps: FoundLamps, sight: Bool[Tensor, "N M"], gain: Float[Tensor, "#N 3"]
    ) -> Float[Tensor, ""]:
        kernel = lamp_kernel(lamps.places, radius, sight, observed, target.material.roughness, lobe)
        brought = kernel[0].mean(0)[:, None] * lamps.intensity
        all_light = brought.sum(0) + beside.scene[0].mean(0)
        misfit = objective.misfit(lamps.intensity, Transport(kernel, beside.scene), target, gain)
        return misfit + objective.price(brought.mean(-1), all_light)

    def settle(lamps: FoundLamps) -> _Settled:
        # A shadow's edge has no derivative here: what is hidden at the start stays hidden in this fit.
        sight = in_sight(lamps.places, radius, observed.position, scene)
        return _descend(lamps, target, objective, lambda moved, gain: loss_of(moved, sight, gain))

    best = settle(found)
    if not math.isfinite(best.loss):
        return found
    for number in reversed(range(len(found.intensity))):
        if len(best.lamps.intensity) == 1:
            break
        without = settle(_without(best.lamps, number))
        if without.loss < best.loss:
            best = without
    for number in range(len(best.lamps.intensity)):
        pair = best, settle(_of_other_kind(best.lamps, number, observed.position))
        panel, bulb = pair if best.lamps.places.axis[number].any() else reversed(pair)
        best = panel if panel.loss < (1 - PANEL_GAIN) * bulb.loss else bulb
    return settle(best.lamps).lamps


def _of_other_kind(lamps: FoundLamps, number: int, points: Float[Tensor, "N 3"]) -> FoundLamps:
    """All lamps as they are, but a panel that is a bulb, or a bulb that faces the points as a panel."""
    position, axis = lamps.places.position[number], lamps.places.axis.clone()
    towards = safe_normalize((points - position).mean(0, keepdim=True))[0]
    axis[number] = torch.where(axis[number].any(), 0.0, towards)
    return FoundLamps(LampPlaces(lamps.places.position, axis), lamps.intensity)


def _without(lamps: FoundLamps, number: int) -> FoundLamps:
    """All lamps but one, whose power goes to the nearest other."""
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
    """The nearest minimum of a loss over place, axis and intensity; the start if that is not finite."""
    bare = start.places.axis.square().sum(-1, keepdim=True) == 0
    position = start.places.position.clone().requires_grad_()
    axis = start.places.axis.clone().requires_grad_()
    log_intensity = start.intensity.clamp_min(FAINT_SHARE * start.intensity.max()).log().requires_grad_()

    def lamps() -> FoundLamps:
        return FoundLamps(
            LampPlaces(position, safe_normalize(axis).masked_fill(bare, 0.0)), log_intensity.exp()
        )

    unknowns = (Unknown(position, RATE), Unknown(axis, AXIS_RATE), Unknown(log_intensity, AXIS_RATE))
    loss = descend(unknowns, GAIN_RATE, STEPS, target, objective, lambda gain: loss_of(lamps(), gain)).item()
    settled = lamps()
    settled = FoundLamps(settled.places.detach(), settled.intensity.detach())
    values = torch.cat((settled.places.position, settled.places.axis, settled.intensity))
    finite = math.isfinite(loss) and values.isfinite().all()
    return _Settled(settled, loss) if finite else _Settled(start, math.inf)
