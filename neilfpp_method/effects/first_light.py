"""Find an initial light for training from surface places that many views show.

Training alternates between light and material. If it starts from a uniform grey material under an even
light, it often converges to a wrong solution: the initial material has no sharp highlights, so the first
fitted light is blurred, and under a blurred light the surfaces learn to be rough and dark. For only a
thousand places it is possible to try all values instead: every roughness and metallic of a grid at each
place, and several values of the scale factor between light and base colour, which the images do not
determine. Held-back views select the scale.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass

import torch

from neilfpp_method.effects.evidence.lamps import LampTrial
from neilfpp_method.effects.light_scale import FIRST_SCALE, SCALES, lowest_scale, scale_of_metals, with_prior
from neilfpp_method.effects.places.data import PlaceData
from neilfpp_method.effects.places.fit import (
    FIRST_STEPS,
    ROUNDS,
    STEPS,
    Permitted,
    PlaceFit,
    fit_places,
    place_errors,
    seconds_of_step,
)
from neilfpp_method.structures import Material

__all__ = ["CARRIED_ROUNDS", "MIN_PLACES", "FirstLight", "find_first_light", "seconds_of_pixel"]

MIN_PLACES = 100
"""Minimum number of places for an initial light."""
FOLDS = 5
"""One in this many views is held back."""
CARRIED_ROUNDS = 2
"""Alternations of light and material in a fit that starts from the fit of another scale or of fewer views."""
ALTERNATIVE_FITS = 1.8
"""Time of one alternative of `evidence.alternatives` in units of a fit to all pixels: four fits to three
quarters of them, each with half the usual number of rounds.
"""
TIMED_PIXELS = 2000
"""Pixels of the products from which `seconds_of_pixel` is estimated."""
OVERHEAD_SHARE = 1.3
"""Share that tracing, the copies of the transport, and the search for materials add to the descents of the
light, on one core of a server: with both kinds of evidence 5,000 pixels took 25 s, of which 15 s are descents
by this count; without evidence 8.2 and 3.5 s.
"""


@dataclass(frozen=True)
class FirstLight:
    """An initial light and material.

    Attributes:
        fit: the map, and the materials of the places.
        scale: the chosen mean base colour (`light_scale`).
        errors: relative error in the held-back views for each mean base colour that was tried.
        data: the places.
        metals: whether metallic may be greater than 0.
        lamp_trial: measures whether lamps explain held-back views better.
    """

    fit: PlaceFit
    scale: float
    errors: Mapping[float, float]
    data: PlaceData
    metals: bool
    lamp_trial: LampTrial

    @property
    def mean(self) -> Material:
        """Mean material of the places, N = 1; for base colour the geometric mean."""
        materials = self.fit.material(self.data.places.place.unique())
        return Material(
            materials.base_color.log().mean(0, keepdim=True).exp(),
            materials.roughness.mean(0, keepdim=True),
            materials.metallic.mean(0, keepdim=True),
        )

    def summary(self) -> str:
        """One line for the console."""
        bounded = SCALES[0] < self.scale < SCALES[-1]
        caution = "" if bounded else " (at the end of the range that was tried)"
        count = self.data.places.shown_count
        return f"initial light: fitted at {count} places; mean base colour {self.scale:.2f}{caution}"


@torch.no_grad()
def find_first_light(data: PlaceData, metals: bool) -> FirstLight | None:
    """Fit a map together with the materials of places.

    Args:
        data: places with their pixels in the training views.
        metals: whether metallic may be greater than 0.

    Returns:
        The initial light; None if there are fewer than `MIN_PLACES` places.
    """
    if data.places.shown_count < MIN_PLACES:
        return None
    split = data.hold_back(0, FOLDS)
    fits = {FIRST_SCALE: fit_places(split.known, Permitted(metals, FIRST_SCALE))}
    for scale in (*(s for s in SCALES if s > FIRST_SCALE), *(s for s in reversed(SCALES) if s < FIRST_SCALE)):
        start = _nearest(fits, scale)
        fits[scale] = fit_places(split.known, Permitted(metals, scale), start, CARRIED_ROUNDS)
    errors = {scale: place_errors(fit, split.held_back) for scale, fit in fits.items()}
    mean_errors = {scale: error.mean().item() for scale, error in errors.items()}
    scale = scale_of_metals(fits, errors, split.held_back.places)
    if scale is None:
        scale = lowest_scale(with_prior(mean_errors, data.response))
    start = _nearest(fits, scale)

    def fit_on(changed: PlaceData) -> PlaceFit:
        return fit_places(changed, Permitted(metals, scale), start, CARRIED_ROUNDS)

    return FirstLight(fit_on(data), scale, mean_errors, data, metals, LampTrial(split, fit_on))


def seconds_of_pixel(device: torch.device, with_lobe: bool, with_metals: bool) -> float:
    """Estimate the time of `find_first_light` on this machine per pixel of the places, in seconds.

    Args:
        device: device of the computation.
        with_lobe: whether to include the time of evidence for the lobe of highlights.
        with_metals: whether to include the time of evidence for metals.
    """
    whole = FIRST_STEPS + (ROUNDS - 1) * STEPS
    carried = CARRIED_ROUNDS * STEPS
    # One fit per scale, two fits with and without lamps, and the final fit to all views.
    steps = (1 - 1 / FOLDS) * (whole + (len(SCALES) + 1) * carried) + carried
    # Two lobes, and metal and paint. If both are compared, one alternative is common to them. A short fit
    # finds their scale.
    alternatives = {(False, False): 0, (True, True): 3}.get((with_lobe, with_metals), 2)
    steps += alternatives * ALTERNATIVE_FITS * whole + (FIRST_STEPS if alternatives else 0)
    return (1 + OVERHEAD_SHARE) * steps * seconds_of_step(TIMED_PIXELS, device) / TIMED_PIXELS


def _nearest(fits: Mapping[float, PlaceFit], scale: float) -> PlaceFit:
    """The fit of the nearest scale, brightened to this scale."""
    nearest = min(fits, key=lambda tried: abs(math.log(tried / scale)))
    return fits[nearest].brightened(scale / nearest)
