"""Settle the lamps of an initial light, together with its map, its scale, and the materials of the places.

`LightSolver.start` finds lamps beside a map that was fitted without them. Part of their light is in that map,
and materials hide their highlights in roughness. Surfaces that learn under such a light confirm it, so that
training would leave the lamps where they are. At places every material is tried. Three steps alternate:

1. map and materials are fitted under the light of the lamps,
2. held-back views select the scale between light and base colour,
3. the lamps are settled beside the map, on surfaces of these materials, at all pixels of the places: with
   4096 of 16,000 pixels, lamps were up to 0.07 scene units from the truth, with all of them up to 0.04.
"""

from __future__ import annotations

import copy
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import torch

from neilfpp_method.effects.first_light import CARRIED_ROUNDS, FirstLight
from neilfpp_method.effects.light_scale import SCALES, lowest_scale, with_prior
from neilfpp_method.effects.places.data import PlaceData, lamp_light
from neilfpp_method.effects.places.fit import Permitted, PlaceFit, at_roughness, fit_places, place_errors
from neilfpp_method.fields.lamps import Lamps
from neilfpp_method.lighting.candidates import FoundLamps
from neilfpp_method.lighting.fit_points import FitPoints
from neilfpp_method.lighting.objective import Objective
from neilfpp_method.lighting.settle import settle_lamps
from neilfpp_method.shading.brdf import Lobe
from neilfpp_method.structures import SceneTracer

__all__ = ["FirstLamps", "settle_first_lamps"]

ROUNDS = 4
"""Number of alternations."""
FACTORS = (0.77, 1.0, 1.3)
"""Factors on base colour that are tried in each round after the first. The first one tries all `SCALES`: a
map without lamps is often too bright, and only its lamps then reveal the scale.
"""
MAX_RISE = 1.2
"""Largest ratio of the error in held-back views to that of the alternation before. While the lamp of a ball
settled, the error rose by up to 11 %; when the lamp moved far away, by a quarter to a half.
"""


@dataclass(frozen=True)
class FirstLamps:
    """An initial light with lamps.

    Attributes:
        light: its map and materials.
        lamps: its lamps.
    """

    light: FirstLight
    lamps: FoundLamps


@dataclass(frozen=True)
class _Turn:
    """The state of the alternation.

    Attributes:
        fit: map and materials.
        scale: their mean base colour.
        lamps: the lamps.
        errors: error in held-back views for each scale that was tried under these lamps.
    """

    fit: PlaceFit
    scale: float
    lamps: Lamps
    errors: Mapping[float, float]

    @property
    def error(self) -> float:
        """The lowest of the errors; infinite before any was measured."""
        return min(self.errors.values(), default=math.inf)


@torch.no_grad()
def settle_first_lamps(first: FirstLight, found: Lamps, lobe: Lobe, scene: SceneTracer | None) -> FirstLamps:
    """Settle lamps together with an initial light that was fitted without them.

    If the error in held-back views rises clearly, the alternation ends, and the last lamps are discarded.

    Args:
        first: the initial light without lamps.
        found: the lamps that were found beside it; they are not changed.
        lobe: the specular lobe.
        scene: traces shadow rays; None if inter-reflection is off.
    """
    best = turn = _Turn(first.fit, first.scale, found, {})
    for number in range(ROUNDS):
        scales = SCALES if number == 0 else [turn.scale * factor for factor in FACTORS]
        fitted = _fit_under_lamps(turn, scales, first, lobe, scene)
        if fitted.error > MAX_RISE * best.error:
            turn = best
            break
        best = fitted
        turn = replace(best, lamps=_settled(best, first.lamp_trial.split.known, lobe, scene))
    lit = first.data.with_light(lamp_light(first.data.places, turn.lamps, lobe, scene))
    fit = fit_places(lit, Permitted(first.metals, turn.scale), turn.fit, CARRIED_ROUNDS)
    light = replace(first, fit=fit, scale=turn.scale, errors=turn.errors)
    return FirstLamps(light, FoundLamps(turn.lamps.lit_places, turn.lamps.lit_intensity))


def _fit_under_lamps(
    turn: _Turn, scales: Sequence[float], first: FirstLight, lobe: Lobe, scene: SceneTracer | None
) -> _Turn:
    """Fit map and materials under the light of the lamps, and choose the best of the scales for all three."""
    split, lamps = first.lamp_trial.split, copy.deepcopy(turn.lamps)

    def improved(fit: PlaceFit, data: PlaceData, scale: float, rounds: int) -> PlaceFit:
        return fit_places(data, Permitted(first.metals, scale), fit, rounds)

    known, held_back = (
        lamp_light(part.places, lamps, lobe, scene) for part in (split.known, split.held_back)
    )
    fit, errors = improved(turn.fit, split.known.with_light(known), turn.scale, CARRIED_ROUNDS), {}
    for scale in scales:
        factor = scale / turn.scale
        tried = improved(fit.brightened(factor), split.known.with_light(known / factor), scale, 1)
        error = place_errors(tried, split.held_back.with_light(held_back / factor))
        errors[scale] = error.mean().item()
    scale = lowest_scale(with_prior(errors, first.data.response))
    lamps.intensity.div_(scale / turn.scale)
    return _Turn(fit.brightened(scale / turn.scale), scale, lamps, errors)


def _settled(turn: _Turn, data: PlaceData, lobe: Lobe, scene: SceneTracer | None) -> Lamps:
    """The lamps, settled beside the map of a fit and on surfaces of its materials."""
    lamps, place = copy.deepcopy(turn.lamps), data.places.place
    number = place.unique(return_inverse=True)[1]
    points = FitPoints(data.places.observed, turn.fit.material(place), lobe, scene, number)
    beside = at_roughness(data.transport, turn.fit.roughness[place]).with_strength(turn.fit.radiance)
    found = FoundLamps(lamps.lit_places, lamps.lit_intensity)
    # Places have linear radiance, whatever the response of the capture is.
    objective = Objective("linear", data.typical)
    settled = settle_lamps(found, lamps.radius, beside, points, objective)
    lamps.place(settled.places.position, settled.intensity, settled.places.axis)
    return lamps
