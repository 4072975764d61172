"""Correct the scale between light and base colour under the light of a half-trained model.

The scale of the initial light (`effects.light_scale`) is off by up to a quarter, because its coarse map blurs
the highlights that reveal it. The map of a half-trained model is sharper. So the light is divided by several
factors, the best material of each place is found under each of these lights, and held-back views select the
factor.
"""

from __future__ import annotations

from dataclasses import dataclass

import torch

from neilfpp_method.effects.light_scale import MIN_METAL_SHARE, lowest_scale, with_prior
from neilfpp_method.effects.places.lit import PAINT, PAINT_OR_METAL, LitPlaces
from neilfpp_method.lighting.objective import DARK_FLOOR
from neilfpp_method.lighting.solver import LightSolver
from neilfpp_method.model import NeilfModel

__all__ = ["FACTORS", "Rescaled", "correct_scale"]

FACTORS = (0.59, 0.7, 0.84, 1.0, 1.19, 1.41, 1.68)
"""Factors on base colour that are tried, in equal steps of the logarithm. Initial scales are off by less."""
FOLDS = 5
"""Number of folds of the views. Each of them is held back once."""


@dataclass(frozen=True)
class Rescaled:
    """The result of `correct_scale`.

    Attributes:
        before: geometric mean of the base colour of the places before.
        factor: factor by which base colours became brighter, and the light weaker.
        lit: the places under the light afterwards.
    """

    before: float
    factor: float
    lit: LitPlaces

    def summary(self) -> str:
        """One line for the console."""
        after = self.before * self.factor
        return f"scale of light and base colour: mean base colour {self.before:.2f} → {after:.2f}"


@torch.no_grad()
def correct_scale(model: NeilfModel, solver: LightSolver, lit: LitPlaces) -> Rescaled | None:
    """Make base colours brighter and the light weaker by the factor that explains held-back views best.

    Args:
        model: gives the current materials, and the response of the capture. For display values, the usual
            base colour is a weak prior, as in the search for the initial light.
        solver: keeps the scale in later fits of the light.
        lit: places under the light of the model.

    Returns:
        The places under the changed light; None if the scale is known (`LightSolver.scale_is_free`), or if so
        many places are metal that no reflection reveals it.
    """
    current = model.brdf(lit.places.shared_points().position)
    if not solver.scale_is_free or (current.metallic > 0.5).float().mean() >= MIN_METAL_SHARE:
        return None
    mean = current.base_color.clamp_min(DARK_FLOOR).log().mean().exp().item()
    permitted = PAINT_OR_METAL if model.brdf.metals else PAINT
    errors = dict.fromkeys((mean * factor for factor in FACTORS), 0.0)
    for number in range(FOLDS):
        split = lit.hold_back(number, FOLDS)
        for factor in FACTORS:
            material = split.known.dimmed(factor).best(permitted).material
            error = split.held_back.dimmed(factor).error(material)
            errors[mean * factor] += error.abs().clamp_max(1).mean().item() / FOLDS
    factor = lowest_scale(with_prior(errors, model.facts.response)) / mean
    solver.rescale(factor)
    model.brdf.brighten(mean, factor)
    return Rescaled(mean, factor, lit.dimmed(factor))
