"""Find an initial light for training from surface places that many views show.

Training alternates between light and material. If it starts from a uniform grey material under an even
light, it often converges to a wrong solution: the initial material has no sharp highlights, so the first
fitted light is blurred, and under a blurred light the surfaces learn to be rough and dark. At a thousand
places all values can be tried instead: each roughness and metallic of a grid at each place, and several
values of the scale that the images leave open between light and base colour. Held-back views select the
scale.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass

import torch
from jaxtyping import Float
from torch import Tensor

from neilfpp_method.effects.lamps import LampTrial
from neilfpp_method.effects.place_fit import (
    FIRST_STEPS,
    ROUNDS,
    STEPS,
    PlaceFit,
    fit_places,
    place_errors,
    seconds_of_step,
)
from neilfpp_method.effects.places import Places
from neilfpp_method.lighting.transport import Transport
from neilfpp_method.model import NeilfModel
from neilfpp_method.structures import Material, Observed

__all__ = ["MIN_PLACES", "FirstLight", "find_first_light", "seconds_of_pixel", "start_with"]

MIN_PLACES = 100
"""Minimum number of places for an initial light."""
FOLDS = 5
"""One in this many views is held back."""
SCALES = (0.1, 0.15, 0.22, 0.33, 0.5, 0.7)
"""Geometric means of the base colour that are tried: about those of charcoal to snow."""
FIRST_SCALE = 0.33
"""The scale that is fitted first, from an even light; every other fit starts from that of the nearest scale.
"""
LAMP_PIXELS = 1024
"""Number of pixels for the search for lamps: as many as the light solver remembers in preset `fast`."""
CARRIED_ROUNDS = 2
"""Alternations of light and material in a fit that starts from the fit of another scale or of fewer views."""


LOBE_FITS = 3.6
"""Fits to all pixels that take as long as evidence for the lobe: eight shorter ones to three quarters."""
METAL_FITS = 3.8
"""Fits to all pixels that take as long as evidence for metals: eight shorter ones to four fifths."""
MEASURED = 2000
"""Pixels of the products from which `seconds_of_pixel` is estimated."""
REST = 0.3
"""Share that tracing and the search for materials add to the descents of the light, on one core of a server:
1270 pixels took 15.5 s, of which 13 s are descents by this count.
"""


@dataclass(frozen=True)
class FirstLight:
    """An initial light and material.

    Attributes:
        log_radiance: logarithm of the radiance of the map.
        mean: mean material of the places, N = 1; for base colour the geometric mean.
        errors: relative error in the held-back views for each mean base colour that was tried.
        scale: the mean base colour with the lowest error.
        places: number of places.
        observed: at most `LAMP_PIXELS` pixels of the places, for the search for lamps.
        material: material of these pixels, with the same base colour everywhere. In the fit the base colour
            of each place is free, so that it contains the light of lamps.
        lamp_trial: measures whether lamps explain held-back views better.
    """

    log_radiance: Float[Tensor, "3 H W"]
    mean: Material
    errors: Mapping[float, float]
    scale: float
    places: int
    observed: Observed
    material: Material
    lamp_trial: LampTrial

    def summary(self) -> str:
        """One line for the console."""
        ends = self.errors[SCALES[0]], self.errors[SCALES[-1]]
        bounded = min(self.errors.values()) < min(ends)
        caution = "" if bounded else " (at the end of the range that was tried)"
        return f"initial light: fitted at {self.places} places; mean base colour {self.scale:.2f}{caution}"


@torch.no_grad()
def find_first_light(places: Places, transport: Transport, typical: float, metals: bool) -> FirstLight | None:
    """Fit a map together with the materials of places.

    Args:
        places: places with their pixels in the training views, in linear radiance.
        transport: transport to the same pixels (`place_fit.place_transport`).
        typical: radiance of a typical pixel.
        metals: whether metallic may be greater than 0.

    Returns:
        The initial light; None if there are fewer than `MIN_PLACES` places.
    """
    numbers = places.place.unique()
    if len(numbers) < MIN_PLACES:
        return None
    is_held_back = places.view % FOLDS == 0
    fitted, held_back = torch.nonzero(~is_held_back)[:, 0], torch.nonzero(is_held_back)[:, 0]
    known = places.where(fitted), transport[fitted]
    unknown = places.where(held_back), transport[held_back]

    fits = {FIRST_SCALE: fit_places(*known, typical, metals, FIRST_SCALE)}
    for scale in (*(s for s in SCALES if s > FIRST_SCALE), *(s for s in reversed(SCALES) if s < FIRST_SCALE)):
        start = _rescaled(fits, scale)
        fits[scale] = fit_places(*known, typical, metals, scale, start, CARRIED_ROUNDS)
    errors = {scale: place_errors(fit, *unknown, typical).mean().item() for scale, fit in fits.items()}
    scale = _lowest(errors)
    best = fit_places(places, transport, typical, metals, scale, _rescaled(fits, scale), CARRIED_ROUNDS)
    materials = best.material(numbers)
    mean = Material(
        materials.base_color.log().mean(0, keepdim=True).exp(),
        materials.roughness.mean(0, keepdim=True),
        materials.metallic.mean(0, keepdim=True),
    )
    drawn = torch.randperm(len(places.place), device=places.place.device)[:LAMP_PIXELS]
    material = best.material(places.place[drawn])
    even = Material(mean.base_color.expand(len(drawn), 3), material.roughness, material.metallic)
    start = _rescaled(fits, scale)

    def refit(changed: Transport) -> PlaceFit:
        return fit_places(known[0], changed, typical, metals, scale, start, CARRIED_ROUNDS)

    trial = LampTrial(*known, *unknown, typical, refit)
    return FirstLight(
        best.log_radiance, mean, errors, scale, len(numbers), places.observed[drawn], even, trial
    )


def seconds_of_pixel(device: torch.device, with_lobe: bool, with_metals: bool) -> float:
    """Estimate how long the search takes here for each pixel that places have.

    Args:
        device: where it is done.
        with_lobe: whether evidence for the lobe of highlights is measured, too.
        with_metals: whether evidence for metals is measured, too.
    """
    whole = FIRST_STEPS + (ROUNDS - 1) * STEPS
    carried = CARRIED_ROUNDS * STEPS
    # The scales, the two fits with and without lamps, and the final one to all views.
    steps = (1 - 1 / FOLDS) * (whole + (len(SCALES) + 1) * carried) + carried
    steps += (LOBE_FITS * with_lobe + METAL_FITS * with_metals) * whole
    return (1 + REST) * steps * seconds_of_step(MEASURED, device) / MEASURED


@torch.no_grad()
def start_with(model: NeilfModel, found: FirstLight) -> None:
    """Set the light of a model, and the initial material of its untrained BRDF field."""
    log_radiance = found.log_radiance
    model.light.resample(
        log_radiance.mean(0, keepdim=True).expand_as(log_radiance)
        if model.config.light.monochrome
        else log_radiance
    )
    model.brdf.start_at(found.mean)


def _rescaled(fits: Mapping[float, PlaceFit], scale: float) -> PlaceFit:
    """The fit of the nearest scale, with base colours (at most 1) and light scaled inversely."""
    nearest = min(fits, key=lambda tried: abs(math.log(tried / scale)))
    fit, factor = fits[nearest], scale / nearest
    base_color = (fit.base_color * factor).clamp_max(1.0)
    return PlaceFit(fit.log_radiance - math.log(factor), base_color, fit.roughness, fit.metallic)


def _lowest(errors: Mapping[float, float]) -> float:
    """The scale of the lowest error.

    At an end of the range it is the scale that was tried; within the range it is the minimum of the parabola
    through the lowest error and its two neighbours, over the logarithm of the scale.
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
