"""Correct the scale between light and base colour under the light of a half-trained model.

The scale of the initial light (`effects.light_scale`) is off by up to a quarter, because its coarse map blurs
the highlights that reveal it. The map of a half-trained model is sharper. So the light is divided by several
factors, the best paint of each place is found under each of these lights, and held-back views select the
factor. Metals have no reflection that reveals the scale, so places where the field is metal are left out.

The light is most exact after the last step, but then the field can no longer adapt to a correction. So the
last correction multiplies base colours by the factor exactly; earlier ones shift the biases of the field.
"""

from __future__ import annotations

from dataclasses import dataclass

import torch

from neilfpp_method.effects.light_scale import lowest_scale, with_prior
from neilfpp_method.effects.places.lit import PAINT, LitPlaces
from neilfpp_method.lighting.objective import DARK_FLOOR
from neilfpp_method.lighting.solver import LightSolver
from neilfpp_method.model import NeilfModel

__all__ = ["FACTORS", "Rescaled", "correct_final_scale", "correct_scale"]

FACTORS = (0.59, 0.7, 0.84, 1.0, 1.19, 1.41, 1.68)
"""Factors on base colour that are tried, in equal steps of the logarithm. Initial scales are off by less."""
MAX_MEAN = 0.9
"""Largest mean base colour that a factor above 1 may lead to: that of fresh snow."""
FOLDS = 5
"""Number of folds of the views. Each of them is held back once."""
MAX_RISE = 0.05
"""Rise of the error up to which a factor counts for the minimum. At the end of two trainings, estimates from
random selections of places then scattered by 1 to 2 %, in place of 4 to 6 with three factors. Of brighter
paints some are at their bound of 1 under a higher factor, and the error rises steeply.
"""
MIN_PAINT_SHARE = 0.2
"""Minimum share of paint among the places. With 30 %, three random selections of places made the scale of a
trained blob too dark by 4, 6 and 14 %; it was too bright by 16 % before.
"""


@dataclass(frozen=True)
class Rescaled:
    """A correction of the scale.

    Attributes:
        before: geometric mean of the base colour of the places before.
        factor: factor by which base colours become brighter, and the light weaker.
    """

    before: float
    factor: float

    def summary(self) -> str:
        """One line for the console."""
        after = self.before * self.factor
        return f"scale of light and base colour: mean base colour {self.before:.2f} → {after:.2f}"


@torch.no_grad()
def correct_scale(model: NeilfModel, solver: LightSolver, lit: LitPlaces) -> Rescaled | None:
    """Make base colours brighter and the light weaker by the factor that explains held-back views best.

    The BRDF field can be trained further.

    Args:
        model: gives the current materials, and the response of the capture. For display values, the usual
            base colour is a weak prior, as in the search for the initial light.
        solver: keeps the scale in later fits of the light.
        lit: places under the light of the model.

    Returns:
        The correction; None if the scale is known (`LightSolver.scale_is_free`), or if nearly all places are
        metal, so that no reflection reveals it.
    """
    found = _find_correction(model, solver, lit)
    if found is not None:
        solver.rescale(found.factor)
        model.brdf.brighten(found.before, found.factor)
    return found


@torch.no_grad()
def correct_final_scale(model: NeilfModel, solver: LightSolver, lit: LitPlaces) -> Rescaled | None:
    """The same after the last step: base colours are multiplied by the factor exactly.

    Arguments and result are those of `correct_scale`.
    """
    found = _find_correction(model, solver, lit)
    if found is not None:
        solver.rescale(found.factor)
        model.brdf.scale_base_color(found.factor)
    return found


def _find_correction(model: NeilfModel, solver: LightSolver, lit: LitPlaces) -> Rescaled | None:
    """The correction that `correct_scale` makes, or None."""
    current = model.brdf(lit.places.shared_points().position)
    is_paint = current.metallic[:, 0] < 0.5
    if not solver.scale_is_free or is_paint.float().mean() < MIN_PAINT_SHARE:
        return None
    mean = current.base_color.clamp_min(DARK_FLOOR).log().mean().exp().item()
    painted = lit.where(torch.nonzero(is_paint[lit.places.place])[:, 0])
    factors = [factor for factor in FACTORS if factor <= 1 or factor * mean <= MAX_MEAN]
    errors = dict.fromkeys((mean * factor for factor in factors), 0.0)
    for number in range(FOLDS):
        split = painted.hold_back(number, FOLDS)
        for factor in factors:
            material = split.known.dimmed(factor).best(PAINT).material
            error = split.held_back.dimmed(factor).error(material)
            errors[mean * factor] += error.abs().clamp_max(1).mean().item() / FOLDS
    return Rescaled(mean, lowest_scale(with_prior(errors, model.facts.response), MAX_RISE) / mean)
