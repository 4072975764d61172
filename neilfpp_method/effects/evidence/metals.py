"""Evidence for metals, measured at the places of the initial light, which are numerous enough to decide.

It is measured twice: together with the initial light, and again during material init if metals are off.

A dark glossy paint under a bright light looks like a metal in a single view. The change of a place from view
to view distinguishes the two, so places are fitted to most views with metals and without, and the fits are
compared in held-back views.

The mean over all places decides. At places without metal, a fit with metals uses them to compensate for other
errors, which increases the error in held-back views; if a tenth of the places are metal, their benefit
outweighs this. A mean over only those places that the fit classifies as metal would be misleading: if there
is little metal, most of them are classified wrongly.

Photographs deviate from the model by more than renderings do: by tone curves, inaccurate poses and the depth
of field. Metals compensate for some of this in held-back views, too, a little at many places. So for display
values the benefit with the initial light must be larger. Under the trained light some places must have a much
lower error, as real metal has.

On recovered surfaces the first measurement is uncertain: its light is a coarse map without lamps. In two
samples of places of the demo, of which 12 % are metal, it was 0.08 ± 0.05 % and 0.25 ± 0.05 %, with gains at
paint as well. Under the light of a half-trained model only metal has a gain (1.3 ± 0.4 %, paint 0.0 %).
"""

from __future__ import annotations

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from neilfpp_method.effects.evidence.alternatives import Alternatives, reduction
from neilfpp_method.effects.measurement import Measurement, mean_of, mean_reduction
from neilfpp_method.effects.places.lit import METAL, PAINT, LitPlaces
from neilfpp_method.effects.places.search import SearchedMaterial, found_in
from neilfpp_method.fields.brdf import BrdfField
from neilfpp_method.structures import Material

__all__ = ["find_metal", "metals_evidence", "metals_evidence_in"]

FOLDS_UNDER_LIGHT = 5
"""Number of folds of the views under the trained light; every fold is held back in turn."""
THRESHOLD = 0.0
"""Threshold for the reduction of the relative error. Metals take no additional time, so they are left out
only if they increase the error.
"""
THRESHOLD_UNDER_LIGHT = 0.0003
"""The same under the trained light, where the standard error can be smaller than any visible benefit: a ball
without metal had a reduction of 0.006 ± 0.003 %. The demo, of which 12 % is metal, has 0.11 %.
"""
THRESHOLD_IN_DISPLAY_VALUES = 0.035
"""The same with the initial light, for images with display values. Three captures of photographs without
metal had reductions of 1.5 to 2.3 %; an object of which a third is metal had 5 % after a tone curve
(docs/notebook/2026-11-27-decisions-on-effects.md).
"""
CLEAR_RATIO = 0.7
"""In images with display values a place is metal if the error of the best metal is below this share of that
of the best paint, and if that metal reflects at least `MIN_REFLECTANCE`.
"""
MIN_REFLECTANCE = 0.2
"""Minimum base colour of a metal in images with display values, mean of the channels. Real metals reflect
more than twice as much. Black matte paint is explained best by rough metal that is darker than the highlights
of any paint: 3.7 % of the places in photographs without metal.
"""
MIN_CLEAR_SHARE = 0.02
"""Threshold for the share of metal in images with display values under the trained light. Of an object with
9 % of gold 5.5 % of the places are found; of two captures of photographs without metal 0 and 0.9 %.
"""
METAL_RATIO = 0.95
"""In linear images a place is metal under the trained light if the error of the best metal is below this
share of that of the best paint. In the demo this selects half of the metal and 7 % of the paint; a ratio of 1
would select 85 % and 28 %.
"""


def metals_evidence(alternatives: Alternatives, lobe: str) -> Measurement:
    """Mean reduction of the relative error of the places by metals, in held-back views.

    Args:
        alternatives: the ways to explain the places.
        lobe: the lobe of highlights that the model uses.
    """
    paint, metal = (alternatives.errors(lobe, metals) for metals in (False, True))
    display_values = alternatives.facts.response == "srgb"
    threshold = THRESHOLD_IN_DISPLAY_VALUES if display_values else THRESHOLD
    return reduction(paint, metal, "metals", threshold)


@torch.no_grad()
def metals_evidence_in(lit: LitPlaces, response: str) -> Measurement:
    """Evidence for metals under a fixed light, in held-back views.

    Args:
        lit: places under this light.
        response: that of the images.

    Returns:
        For linear images, the mean reduction of the relative error by metals. For display values, the share
        of places that metal explains clearly better than paint.
    """
    if response == "srgb":
        return _share_of_clear_metal(lit)
    reductions = (_reduction_in_held_back_views(lit, fold) for fold in range(FOLDS_UNDER_LIGHT))
    what = "reduction of the error in held-back views by metals, under the trained light"
    return mean_reduction(reductions, what, THRESHOLD_UNDER_LIGHT)


def _reduction_in_held_back_views(lit: LitPlaces, fold: int) -> Float[Tensor, " P"]:
    """The error of each place with the best paint, minus that with metal where it is clearly better."""
    split = lit.hold_back(fold, FOLDS_UNDER_LIGHT)
    paint, metal = split.known.best(PAINT), split.known.best(METAL)
    best = metal.where(_is_metal(paint.loss, metal.loss, metal.material, "linear"), paint)
    return split.held_back.mean_errors(paint.material) - split.held_back.mean_errors(best.material)


def _share_of_clear_metal(lit: LitPlaces) -> Measurement:
    """Share of places that are metal in images with display values, by their errors in held-back views."""
    paint, metal = _loss_in_held_back_views(lit, PAINT), _loss_in_held_back_views(lit, METAL)
    is_metal = _is_metal(paint, metal, lit.best(METAL).material, "srgb")
    what = "places that metal explains clearly better in held-back views, under the trained light"
    return mean_of(is_metal.float(), what, MIN_CLEAR_SHARE)


def _loss_in_held_back_views(lit: LitPlaces, metallics: range) -> Float[Tensor, " P"]:
    """The loss of each place, summed over the held-back folds, with the best material for the other views."""
    splits = (lit.hold_back(fold, FOLDS_UNDER_LIGHT) for fold in range(FOLDS_UNDER_LIGHT))
    return sum(split.held_back.loss(split.known.best(metallics).material) for split in splits)


@torch.no_grad()
def find_metal(lit: LitPlaces, brdf: BrdfField, response: str) -> SearchedMaterial:
    """The material of the places that are metal, and that of the field at all others.

    Args:
        lit: places under a fixed light.
        brdf: gives the current materials.
        response: that of the images.
    """
    paint, metal = lit.best(PAINT), lit.best(METAL)
    return found_in(lit, brdf, metal, _is_metal(paint.loss, metal.loss, metal.material, response))


def _is_metal(
    paint: Float[Tensor, " P"], metal: Float[Tensor, " P"], material: Material, response: str
) -> Bool[Tensor, " P"]:
    """Whether each place is metal.

    Args:
        paint, metal: the errors of the best paint and of the best metal.
        material: the best metal.
        response: that of the images.
    """
    if response == "srgb":
        return (metal < CLEAR_RATIO * paint) & (material.base_color.mean(-1) >= MIN_REFLECTANCE)
    return metal < METAL_RATIO * paint
