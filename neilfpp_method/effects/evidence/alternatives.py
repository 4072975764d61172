"""Compare two ways to explain the same places, in views that neither was fitted to.

Both have the same mean base colour, at which the comparison does not depend on it (`unbounded_scale`).
"""

from __future__ import annotations

from dataclasses import dataclass

import torch
from jaxtyping import Float
from torch import Tensor

from neilfpp_method.effects.light_scale import unbounded_scale
from neilfpp_method.effects.measurement import Measurement, mean_reduction
from neilfpp_method.effects.places.data import PlaceData
from neilfpp_method.effects.places.fit import Permitted, fit_places, mean_errors

__all__ = ["Alternative", "reduction_in_held_back_views"]

ROUNDS = 3
"""Alternations of light and material in a fit: half of the usual number separate the alternatives as well."""


@dataclass(frozen=True)
class Alternative:
    """Materials that may explain places.

    Attributes:
        data: places with their pixels, and the transport to these for one specular lobe.
        metals: whether metallic may be greater than 0.
    """

    data: PlaceData
    metals: bool

    def error(self, turn: int, folds: int, scale: float) -> Float[Tensor, " P"]:
        """Fit with one fold held back; the mean relative error of each place in it, NaN without pixels."""
        split = self.data.hold_back(turn, folds)
        fit = fit_places(split.known, Permitted(self.metals, scale), rounds=ROUNDS)
        return mean_errors(fit, split.held_back)


@torch.no_grad()
def reduction_in_held_back_views(
    simple: Alternative, rich: Alternative, folds: int, turns: int, by: str, threshold: float
) -> Measurement:
    """Mean reduction of the relative error of the places by the richer alternative.

    Args:
        simple: the alternative whose error is the reference, at the same pixels as the other.
        rich: the alternative that may reduce it.
        folds: number of folds of the views; one of them is held back at a time.
        turns: number of folds that are held back in turn.
        by: what distinguishes the richer alternative, for the description of the measurement.
        threshold: reduction above which the richer alternative is used.
    """
    scale = unbounded_scale(simple.data)
    reductions = (simple.error(turn, folds, scale) - rich.error(turn, folds, scale) for turn in range(turns))
    return mean_reduction(reductions, f"reduction of the error in held-back views by {by}", threshold)
