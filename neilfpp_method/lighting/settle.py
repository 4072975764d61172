"""Found lamps move to where they explain the points best, and those that are not needed go.

Guesses lie beside a lamp, never on it, so what a fit finds is a lamp in pieces: several guesses around it and some beyond, too
strong together. Their places are refined by descent, in turns with the choice of guesses: conditional gradients with moving
atoms (Boyd, Schiebinger and Recht 2017, "The alternating descent conditional gradient method for sparse inverse problems").
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from neilfpp_method.config import LightFitConfig
from neilfpp_method.fields.lamps import LampPlaces
from neilfpp_method.lighting.candidates import FoundLamps
from neilfpp_method.lighting.memory import Observed
from neilfpp_method.lighting.objective import Target, misfit, price
from neilfpp_method.lighting.transport import SceneTracer, Transport, in_sight, lamp_kernel
from neilfpp_method.shading.brdf import Lobe
from neilfpp_method.shading.frame import safe_normalize

__all__ = ["settle_lamps"]

STEPS = 100
RATE = 0.02
"""Scene units per step, at the start."""
QUICKER = 3.0
"""Rate of axes and of logarithms of intensity over that of places."""
LEAST_RATE = 0.05
"""The last step's rate over the first's."""
FAINTEST = 1e-3
"""Of the strongest: a channel that is darker starts here, where its logarithm has a slope."""


@dataclass(frozen=True)
class _Settled:
    lamps: FoundLamps
    loss: float


@torch.no_grad()
def settle_lamps(
    found: FoundLamps,
    radius: float,
    beside: Transport,
    seen: Observed,
    target: Target,
    lobe: Lobe | None,
    scene: SceneTracer | None,
    response: str,
    unit: float,
    config: LightFitConfig,
) -> FoundLamps:
    """Where the lamps are, which way they send and how strong they are, once all of it may change; no more than it takes.

    From the weakest to the strongest a lamp goes where the others, its power with its neighbour, do as well without it.

    Args:
        found: lamps to start from, the strongest first.
        radius: of each, scene units.
        beside: all other light, with no sources of its own.
        seen, target: the points, and what they look like.
        lobe, scene: as of `from_texels`.
        response, unit, config: as of `fit_light`.
    """
    if not len(found.intensity) or not len(seen):
        return found

    def loss_of(lamps: FoundLamps, sight: Bool[Tensor, "N M"], gain: Float[Tensor, " 3"]) -> Float[Tensor, ""]:
        kernel = lamp_kernel(lamps.places, radius, sight, seen, target.material.roughness, lobe)
        brought = kernel[0].mean(0)[:, None] * lamps.intensity
        all_light = brought.sum(0) + beside.scene[0].mean(0)
        misses = misfit(lamps.intensity, Transport(kernel, beside.scene), target, gain, response, unit, config)
        return misses + price(brought.mean(-1), all_light, config)

    def settle(lamps: FoundLamps) -> _Settled:
        # A shadow's edge has no derivative here: what is hidden at the start stays so, and the next fit looks again.
        return _descend(lamps, loss_of, in_sight(lamps.places, radius, seen.position, scene))

    best = settle(found)
    for number in reversed(range(len(found.intensity))):
        if len(best.lamps.intensity) == 1:
            break
        without = settle(_without(best.lamps, number))
        if without.loss < best.loss:
            best = without
    return best.lamps


def _without(lamps: FoundLamps, number: int) -> FoundLamps:
    """All lamps but one, whose power goes to the nearest other."""
    others = torch.arange(len(lamps.intensity), device=lamps.intensity.device) != number
    places, intensity = lamps.places[others], lamps.intensity[others]
    nearest = (places.position - lamps.places.position[number]).norm(dim=-1).argmin()
    intensity[nearest] += lamps.intensity[number]
    return FoundLamps(places, intensity)


def _descend(
    start: FoundLamps, loss_of: Callable[[FoundLamps, Tensor, Tensor], Tensor], sight: Bool[Tensor, "N M"]
) -> _Settled:
    """To the nearest minimum of a loss over place, axis, intensity, and a factor per channel that is free as in `fit_light`.
    Where that leads to what is not finite: the start."""
    bare = start.places.axis.square().sum(-1, keepdim=True) == 0
    position = start.places.position.clone().requires_grad_()
    axis = start.places.axis.clone().requires_grad_()
    log_intensity = start.intensity.clamp_min(FAINTEST * start.intensity.max()).log().requires_grad_()
    log_gain = torch.zeros_like(start.intensity[0], requires_grad=True)
    rates = ((position, 1.0), (axis, QUICKER), (log_intensity, QUICKER), (log_gain, 1.0))
    optimizer = torch.optim.Adam([{"params": [p], "rate": RATE * rate} for p, rate in rates], betas=(0.9, 0.99))

    def lamps() -> FoundLamps:
        return FoundLamps(LampPlaces(position, safe_normalize(axis).masked_fill(bare, 0.0)), log_intensity.exp())

    with torch.enable_grad():
        for step in range(STEPS):
            for group in optimizer.param_groups:
                group["lr"] = group["rate"] * LEAST_RATE ** (step / STEPS)
            optimizer.zero_grad()
            loss_of(lamps(), sight, log_gain.exp()).backward()
            optimizer.step()
    settled = lamps()
    loss = loss_of(settled, sight, log_gain.exp()).item()
    return _Settled(settled, loss) if math.isfinite(loss) else _Settled(start, math.inf)
