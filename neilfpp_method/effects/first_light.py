"""The light that training starts with, from places that many views show.

Light and material are found in turns, and a start of grey paint under an even light leads the turns astray:
on it no highlight is sharp, so the light that is found first is blurred, and surfaces then learn to be rough
and dark under it. At a thousand places everything can be tried instead: each roughness and each metallic at
each place, and the scale that light and base colour share. Views that were kept back decide on the scale.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass

import torch
from jaxtyping import Float
from torch import Tensor

from neilfpp_method.effects.place_fit import (
    FIRST_STEPS,
    ROUNDS,
    STEPS,
    PlaceFit,
    fit_places,
    place_errors,
    place_transport,
    seconds_of_step,
)
from neilfpp_method.effects.places import Places
from neilfpp_method.fields.direction_map import interpolate, map_directions
from neilfpp_method.model import NeilfModel
from neilfpp_method.shading.brdf import Lobe
from neilfpp_method.structures import Material, Observed, SceneTracer

__all__ = ["MIN_PLACES", "FirstLight", "find_first_light", "seconds_of_pixel", "start_with"]

MIN_PLACES = 100
"""Places from which a light is found."""
FOLDS = 5
"""Of the views one in so many is kept back."""
SCALES = (0.1, 0.15, 0.22, 0.33, 0.5, 0.7)
"""Geometric means of the base colour that are tried, from charcoal to snow."""
FIRST_SCALE = 0.33
"""The first of them, from an even light; each other one starts from the nearest that has been tried."""
LAMP_PIXELS = 1024
"""Pixels among which lamps are sought, as many as the light solver remembers in preset `fast`."""
CARRIED_ROUNDS = 2
"""Turns of light and material from a fit at another scale, or to fewer views."""


LOBE_FITS = 3
"""Fits to all pixels that take as long as evidence for the lobe: four to three quarters of them."""
MEASURED = 2000
"""Pixels of the products from which `seconds_of_pixel` is estimated."""
REST = 0.3
"""Share that tracing and the search for materials add to the descents of the light, on one core of a server:
1270 pixels took 15.5 s, of which 13 s are descents by this count.
"""


@dataclass(frozen=True)
class FirstLight:
    """What was found.

    Attributes:
        log_radiance: of the map.
        mean: of the materials, N = 1; of base colours the geometric mean.
        errors: relative error in the views kept back for each mean base colour that was tried.
        scale: the mean base colour that these errors speak for.
        places: how many.
        observed: pixels of the places, at most `LAMP_PIXELS`, for the search for lamps.
        material: of these pixels. The base colour is the same everywhere: in the fit that of each place is
            free, so it holds the glow of lamps.
    """

    log_radiance: Float[Tensor, "3 H W"]
    mean: Material
    errors: Mapping[float, float]
    scale: float
    places: int
    observed: Observed
    material: Material

    def in_words(self) -> str:
        """For people."""
        ends = self.errors[SCALES[0]], self.errors[SCALES[-1]]
        bounded = "" if min(self.errors.values()) < min(ends) else ", which the views do not bound"
        return f"light starts from {self.places} places: mean base colour {self.scale:.2f}{bounded}"


@torch.no_grad()
def find_first_light(
    places: Places, lobe: Lobe, scene: SceneTracer | None, typical: float, metals: bool
) -> FirstLight | None:
    """A map that explains places together with their materials; none where they are too few.

    Args:
        places: of the training views, with linear radiance.
        lobe: of the specular reflection.
        scene: stands between the places and the map, and shines on them; none where inter-reflection is off.
        typical: radiance of a typical pixel.
        metals: whether metallic may be more than 0.
    """
    shown = places.place.unique()
    if len(shown) < MIN_PLACES:
        return None
    carried = place_transport(places, lobe, scene)
    back = places.view % FOLDS == 0
    fitted, kept_back = torch.nonzero(~back)[:, 0], torch.nonzero(back)[:, 0]
    known, unknown = (places.where(fitted), carried[fitted]), (places.where(kept_back), carried[kept_back])

    fits = {FIRST_SCALE: fit_places(*known, typical, metals, FIRST_SCALE)}
    for scale in (*(s for s in SCALES if s > FIRST_SCALE), *(s for s in reversed(SCALES) if s < FIRST_SCALE)):
        start = _carried(fits, scale)
        fits[scale] = fit_places(*known, typical, metals, scale, start, CARRIED_ROUNDS)
    errors = {scale: place_errors(fit, *unknown, typical).mean().item() for scale, fit in fits.items()}
    scale = _lowest(errors)
    best = fit_places(places, carried, typical, metals, scale, _carried(fits, scale), CARRIED_ROUNDS)
    materials = best.material(shown)
    mean = Material(
        materials.base_color.log().mean(0, keepdim=True).exp(),
        materials.roughness.mean(0, keepdim=True),
        materials.metallic.mean(0, keepdim=True),
    )
    drawn = torch.randperm(len(places.place), device=places.place.device)[:LAMP_PIXELS]
    material = best.material(places.place[drawn])
    even = Material(mean.base_color.expand(len(drawn), 3), material.roughness, material.metallic)
    observed = places.observed[drawn]
    return FirstLight(best.log_radiance, mean, errors, scale, len(shown), observed, even)


def seconds_of_pixel(device: torch.device, with_lobe: bool) -> float:
    """Estimate how long the search takes here for each pixel that places have.

    Args:
        device: where it is done.
        with_lobe: whether evidence for the lobe of highlights is measured, too.
    """
    whole = FIRST_STEPS + (ROUNDS - 1) * STEPS
    carried = CARRIED_ROUNDS * STEPS
    steps = (1 - 1 / FOLDS) * (whole + (len(SCALES) - 1) * carried) + carried
    steps += LOBE_FITS * whole if with_lobe else 0
    return (1 + REST) * steps * seconds_of_step(MEASURED, device) / MEASURED


@torch.no_grad()
def start_with(model: NeilfModel, found: FirstLight) -> None:
    """Give a model whose material is untrained the light that was found, and the mean material."""
    light = model.light.log_radiance
    directions = map_directions(*light.shape[1:]).to(light)
    shown = interpolate(found.log_radiance, directions).permute(2, 0, 1)
    light.copy_(shown.mean(0, keepdim=True) if model.config.light.monochrome else shown)
    model.brdf.start_at(found.mean)


def _carried(fits: Mapping[float, PlaceFit], scale: float) -> PlaceFit:
    """The fit of the nearest scale: brighter surfaces, as far as they stay below 1, under a dimmer light."""
    nearest = min(fits, key=lambda tried: abs(math.log(tried / scale)))
    fit, factor = fits[nearest], scale / nearest
    base_color = (fit.base_color * factor).clamp_max(1.0)
    return PlaceFit(fit.log_radiance - math.log(factor), base_color, fit.roughness, fit.metallic)


def _lowest(errors: Mapping[float, float]) -> float:
    """Where the errors are lowest: at an end, or at the foot of the parabola through the lowest three, over
    the logarithm.
    """
    scales = sorted(errors)
    number = min(range(len(scales)), key=lambda n: errors[scales[n]])
    if number in (0, len(scales) - 1):
        return scales[number]
    left, middle, right = (math.log(scales[n]) for n in (number - 1, number, number + 1))
    rise_left = (errors[scales[number]] - errors[scales[number - 1]]) / (middle - left)
    rise_right = (errors[scales[number + 1]] - errors[scales[number]]) / (right - middle)
    bend = (rise_right - rise_left) / ((right - left) / 2)
    slope = (rise_left * (right - middle) + rise_right * (middle - left)) / (right - left)
    return math.exp(min(max(middle - slope / bend, left), right)) if bend > 0 else scales[number]
