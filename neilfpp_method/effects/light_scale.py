"""Choose the scale between light and base colour.

Twice the light on surfaces half as bright looks nearly the same. Only the reflection of dielectrics, which
does not depend on base colour, reveals the scale. So light and materials are fitted for several mean base
colours, and held-back views select one of them.

Photographs deviate from the model by more than the difference that the scale makes, so that the lowest error
can be at an unlikely scale. For display values, the usual base colour is therefore a weak prior.

Metals have no such reflection: if most places are metal, a wide range of scales explains the held-back views
equally well. The reflectance of real metals selects the scale within this range. Clean metals reflect between
half and nearly all of the light (Akenine-Möller et al., Real-Time Rendering, 4th edition, table 9.2).
"""

from __future__ import annotations

import math
from collections.abc import Mapping

import numpy as np
from jaxtyping import Float
from torch import Tensor

from neilfpp_method.effects.measurement import mean_of
from neilfpp_method.effects.places.data import PlaceData
from neilfpp_method.effects.places.fit import Permitted, PlaceFit, fit_places
from neilfpp_method.effects.places.gathering import Places

__all__ = ["FIRST_SCALE", "SCALES", "lowest_scale", "scale_of_metals", "unbounded_scale", "with_prior"]

SCALES = (0.1, 0.15, 0.22, 0.33, 0.5, 0.7)
"""Geometric means of the base colour that are tried, from about that of charcoal to about that of snow."""
FIRST_SCALE = 0.33
"""The scale that is fitted first, from an even light; every other fit starts from that of the nearest scale.
"""
USUAL_SCALE = 0.3
"""Geometric mean of the base colour that is expected of photographed objects."""
PRIOR_WEIGHT = 0.0125
"""Relative error that counts as much as a scale that is off by a factor of e from the usual one, in images
with display values. Photographs of a pale stone head had errors of 0.199 at a scale of 0.1, of 0.209 at 0.22
and 0.33, and of 0.210 at 0.5. In 8-bit renderings of four scenes, the error at a third of the true scale was
0.004 to 0.015 above the lowest.
"""
METAL_REFLECTANCE = 0.7
"""Typical base colour of a metal, mean of the channels: iron has 0.57, gold 0.71, silver 0.95."""
MIN_METAL_SHARE = 0.5
"""Minimum share of metal among the places for the reflectance of metals to select the scale. With less metal,
the reflection of the dielectrics reveals the scale.
"""
MAX_AT_BOUND = 0.1
"""Largest share of the base colours that may be at their bound of 1 in a fit of paint. If more are, metals
explain the places better for this reason alone: in photographs of a white wall and dark wood without metal,
they reduced the error by 4.3 ± 0.2 % at a mean base colour of 0.33, and by 2.0 ± 0.2 % at 0.1.
"""
AT_BOUND = 0.99
"""Base colour from which on it counts as at its bound."""


def with_prior(errors: Mapping[float, float], response: str) -> dict[float, float]:
    """The errors at each scale, plus the prior on the scale if the response is "srgb"."""
    weight = PRIOR_WEIGHT if response == "srgb" else 0.0
    return {scale: error + weight * math.log(scale / USUAL_SCALE) ** 2 for scale, error in errors.items()}


def lowest_scale(errors: Mapping[float, float], max_rise: float = 0.0) -> float:
    """The scale of the lowest error.

    At an end of the range it is the scale that was tried. Within the range it is the minimum of a parabola
    over the logarithm of the scale, between the neighbours of the lowest error.

    Args:
        errors: the error at each scale.
        max_rise: the parabola fits the lowest error, its two neighbours, and all errors that are higher by at
            most this share. The more errors it fits, the less the noise of each of them matters.
    """
    scales = sorted(errors)
    number = min(range(len(scales)), key=lambda n: errors[scales[n]])
    lowest = scales[number]
    if number in (0, len(scales) - 1):
        return lowest
    neighbors = scales[number - 1 : number + 2]
    limit = (1 + max_rise) * errors[lowest]
    fitted = [scale for scale in scales if scale in neighbors or errors[scale] <= limit]
    bend, slope, _ = np.polyfit(np.log(fitted) - math.log(lowest), [errors[scale] for scale in fitted], deg=2)
    if bend <= 0:
        return lowest
    return min(max(lowest * math.exp(-slope / (2 * bend)), neighbors[0]), neighbors[2])


def scale_of_metals(
    fits: Mapping[float, PlaceFit], errors: Mapping[float, Float[Tensor, " N"]], held_back: Places
) -> float | None:
    """The scale at which metals have the reflectance of real metals, if the images permit it.

    Args:
        fits: light and materials for each scale.
        errors: the error of each fit at the pixels of the held-back views.
        held_back: these pixels.

    Returns:
        The scale closest to that of real metals whose error is not significantly above the lowest; None if
        fewer than `MIN_METAL_SHARE` of the places are metal.
    """
    best = min(errors, key=lambda scale: errors[scale].mean().item())
    shown = held_back.place.unique()
    material = fits[best].material(shown)
    is_metal = material.metallic[:, 0] > 0.5
    if is_metal.float().mean() < MIN_METAL_SHARE:
        return None
    wanted = best * METAL_REFLECTANCE / material.base_color[is_metal].mean(-1).median().item()
    equal = []
    for scale, error in errors.items():
        excess = mean_of(held_back.mean(error - errors[best])[shown], "excess of the error", 0.0)
        if excess.value <= 2 * excess.deviation:
            equal.append(scale)
    return min(max(wanted, min(equal)), max(equal))


def unbounded_scale(data: PlaceData) -> float:
    """The mean base colour for fits whose comparison must not depend on it.

    This is `FIRST_SCALE`, or the highest of `SCALES` below it at which few base colours of paint are at their
    bound of 1.
    """
    for scale in (s for s in reversed(SCALES) if SCALES[0] < s <= FIRST_SCALE):
        base_color = fit_places(data, Permitted(metals=False, mean_base_color=scale), rounds=1).base_color
        if (base_color >= AT_BOUND).float().mean() <= MAX_AT_BOUND:
            return scale
    return SCALES[0]
