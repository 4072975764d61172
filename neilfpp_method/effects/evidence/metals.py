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
of field. Metals compensate for some of this in held-back views, too. So display values need a larger benefit.

On recovered surfaces the first measurement is uncertain: its light is a coarse map without lamps. In two
samples of places of the demo, of which 12 % are metal, it was 0.08 ± 0.05 % and 0.25 ± 0.05 %, with gains at
paint as well. Under the light of a half-trained model only metal has a gain (1.3 ± 0.4 %, paint 0.0 %).
"""

from __future__ import annotations

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from neilfpp_method.effects.evidence.alternatives import Alternatives, reduction
from neilfpp_method.effects.measurement import Measurement, mean_reduction
from neilfpp_method.effects.places.grid import BestMaterials
from neilfpp_method.effects.places.lit import METAL, PAINT, LitPlaces
from neilfpp_method.effects.places.search import SearchedMaterial, found_in
from neilfpp_method.fields.brdf import BrdfField

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
"""The same for images with display values. Three captures of photographs without metal had reductions of 1.5
to 2.3 %; an object of which a third is metal had 5 % after a tone curve
(docs/notebook/2026-11-27-decisions-on-effects.md).
"""
METAL_RATIO = 0.95
"""A place is metal under the trained light if the error of the best metal is below this share of that of the
best paint. In the demo this selects half of the metal and 7 % of the paint; a ratio of 1 would select 85 %
and 28 %.
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
    """The same as `metals_evidence`, under a fixed light."""
    reductions = (_reduction_in_held_back_views(lit, turn) for turn in range(FOLDS_UNDER_LIGHT))
    what = "reduction of the error in held-back views by metals, under the trained light"
    threshold = THRESHOLD_IN_DISPLAY_VALUES if response == "srgb" else THRESHOLD_UNDER_LIGHT
    return mean_reduction(reductions, what, threshold)


def _reduction_in_held_back_views(lit: LitPlaces, turn: int) -> Float[Tensor, " P"]:
    """The error of each place with the best paint, minus that with metal where it is clearly better."""
    split = lit.hold_back(turn, FOLDS_UNDER_LIGHT)
    paint, metal = split.known.best(PAINT), split.known.best(METAL)
    best = metal.where(_is_metal(paint, metal), paint)
    return split.held_back.mean_errors(paint.material) - split.held_back.mean_errors(best.material)


@torch.no_grad()
def find_metal(lit: LitPlaces, brdf: BrdfField) -> SearchedMaterial:
    """The material of the places that are metal, and that of the field at all others."""
    paint, metal = lit.best(PAINT), lit.best(METAL)
    return found_in(lit, brdf, metal, _is_metal(paint, metal))


def _is_metal(paint: BestMaterials, metal: BestMaterials) -> Bool[Tensor, " P"]:
    """Whether the best metal explains each place clearly better than the best paint."""
    return metal.loss < METAL_RATIO * paint.loss
