"""Settle the lamps of an initial light, together with its map, its scale, and the materials of the places.

`LightSolver.start` finds lamps beside a map that was fitted without them. Part of their light is in that map,
and materials hide their highlights in roughness. Surfaces that learn under such a light confirm it, so that
training would leave the lamps where they are. At places every material is tried. Three steps alternate:

1. map and materials are fitted under the light of the lamps,
2. held-back views select the scale between light and base colour,
3. the lamps are settled beside the map, on surfaces of these materials.
"""

from __future__ import annotations

import copy
from dataclasses import dataclass, replace

import torch

from neilfpp_method.effects.first_light import CARRIED_ROUNDS, FirstLight
from neilfpp_method.effects.light_scale import lowest_scale, with_prior
from neilfpp_method.effects.places.data import PlaceData, lamp_light
from neilfpp_method.effects.places.fit import Permitted, PlaceFit, at_roughness, fit_places, place_errors
from neilfpp_method.fields.lamps import Lamps
from neilfpp_method.lighting.candidates import FoundLamps
from neilfpp_method.lighting.fit_points import FitPoints
from neilfpp_method.lighting.objective import Objective
from neilfpp_method.lighting.settle import settle_lamps
from neilfpp_method.shading.brdf import Lobe
from neilfpp_method.structures import SceneTracer

__all__ = ["PIXELS", "FirstLamps", "settle_first_lamps"]

PIXELS = 4096
"""Number of pixels at which lamps are sought and settled. With 1024, the gain by lamps on recovered geometry
varied from −0.4 % to 2.9 % between random selections in a scene with lamps (standard error 0.5 %); with 4096
from 1.3 % to 2.3 %.
"""
ROUNDS = 4
"""Number of alternations."""
FACTORS = (0.77, 1.0, 1.3)
"""Factors on base colour that are tried in each round."""


@dataclass(frozen=True)
class FirstLamps:
    """An initial light with lamps.

    Attributes:
        light: its map and materials.
        lamps: its lamps.
    """

    light: FirstLight
    lamps: FoundLamps


@torch.no_grad()
def settle_first_lamps(first: FirstLight, found: Lamps, lobe: Lobe, scene: SceneTracer | None) -> FirstLamps:
    """Settle lamps together with an initial light that was fitted without them.

    Args:
        first: the initial light without lamps.
        found: the lamps that were found beside it; they are not changed.
        lobe: the specular lobe.
        scene: traces shadow rays; None if inter-reflection is off.
    """
    split, lamps, fit, scale = first.lamp_trial.split, copy.deepcopy(found), first.fit, first.scale

    def improved(fit: PlaceFit, data: PlaceData, scale: float, rounds: int) -> PlaceFit:
        return fit_places(data, Permitted(first.metals, scale), fit, rounds)

    for _ in range(ROUNDS):
        known, held_back = (
            lamp_light(part.places, lamps, lobe, scene) for part in (split.known, split.held_back)
        )
        fit = improved(fit, split.known.with_light(known), scale, CARRIED_ROUNDS)
        errors = {}
        for factor in FACTORS:
            data = split.known.with_light(known / factor)
            tried = improved(fit.brightened(factor), data, scale * factor, 1)
            error = place_errors(tried, split.held_back.with_light(held_back / factor))
            errors[scale * factor] = error.mean().item()
        better = lowest_scale(with_prior(errors, first.data.response))
        fit = fit.brightened(better / scale)
        lamps.intensity.div_(better / scale)
        scale = better
        _settle(lamps, fit, split.known, lobe, scene)
    lit = first.data.with_light(lamp_light(first.data.places, lamps, lobe, scene))
    light = replace(first, fit=improved(fit, lit, scale, CARRIED_ROUNDS), scale=scale, errors=errors)
    return FirstLamps(light, FoundLamps(lamps.lit_places, lamps.lit_intensity))


def _settle(lamps: Lamps, fit: PlaceFit, data: PlaceData, lobe: Lobe, scene: SceneTracer | None) -> None:
    """Settle lamps, in place, beside the map of a fit and on surfaces of its materials."""
    places = data.places
    drawn = torch.randperm(len(places.place), device=places.place.device)[:PIXELS]
    place = places.place[drawn]
    number = place.unique(return_inverse=True)[1]
    points = FitPoints(places.observed[drawn], fit.material(place), lobe, scene, number)
    beside = at_roughness(data.transport[drawn], fit.roughness[place]).with_strength(fit.radiance)
    found = FoundLamps(lamps.lit_places, lamps.lit_intensity)
    # Places have linear radiance, whatever the response of the capture is.
    objective = Objective("linear", data.typical)
    settled = settle_lamps(found, lamps.radius, beside, points, objective)
    lamps.place(settled.places.position, settled.intensity, settled.places.axis)
