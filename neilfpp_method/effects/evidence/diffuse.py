"""Evidence for Disney's diffuse lobe against Lambert's, under the light of a half-trained model.

The two differ at flat angles, by a tenth to a third. While the light is unknown, it makes up for the
difference: with the initial light, Lambert's lobe explains places better that were rendered with Disney's. So
the lobes are compared later, under a light that all pixels have trained.
"""

from __future__ import annotations

import torch
from jaxtyping import Float
from torch import Tensor

from neilfpp_method.effects.measurement import Measurement, mean_reduction
from neilfpp_method.effects.places.lit import PAINT, PAINT_OR_METAL, LitPlaces, with_lobe
from neilfpp_method.model import NeilfModel
from neilfpp_method.shading.brdf import GGX_BURLEY

__all__ = ["diffuse_evidence"]

FOLDS = 3
"""Number of folds of the views; every fold is held back in turn."""
THRESHOLD = 0.0005
"""Threshold for the reduction of the relative error by Disney's lobe. A capture with Lambert's lobe has
−0.14 %, two with Disney's have 0.12 and 0.19 % (docs/notebook/2026-11-28-diffuse-lobe.md).
"""


@torch.no_grad()
def diffuse_evidence(model: NeilfModel, lit: LitPlaces) -> Measurement:
    """Mean reduction of the relative error of the places by Disney's diffuse lobe, in held-back views.

    Args:
        model: its light is an environment map, its lobe GGX with Lambert's diffuse lobe.
        lit: places under this light with this lobe.
    """
    disney, metals = with_lobe(model, lit, GGX_BURLEY), model.brdf.metals
    reductions = (_errors(lit, fold, metals) - _errors(disney, fold, metals) for fold in range(FOLDS))
    what = "reduction of the error in held-back views by Disney's diffuse lobe, under the trained light"
    return mean_reduction(reductions, what, THRESHOLD)


def _errors(lit: LitPlaces, fold: int, metals: bool) -> Float[Tensor, " P"]:
    """The error of each place in a fold of the views, with the best material for the other views."""
    split = lit.hold_back(fold, FOLDS)
    best = split.known.best(PAINT_OR_METAL if metals else PAINT)
    return split.held_back.mean_errors(best.material)
