"""Compare two ways to explain the same places, in views that neither was fitted to."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from jaxtyping import Float
from torch import Tensor

from neilfpp_method.effects.measurement import Measurement, mean_of
from neilfpp_method.effects.place_fit import fit_places, place_errors
from neilfpp_method.effects.places import Places
from neilfpp_method.lighting.transport import Transport

__all__ = ["Alternative", "reduction_in_held_back_views"]

ROUNDS = 3
"""Alternations of light and material in a fit: half of the usual number separate the alternatives as well."""
SCALE = 0.33
"""Mean base colour of all fits. The comparison does not depend on the scale of light and base colour."""


@dataclass(frozen=True)
class Alternative:
    """A set of materials.

    Attributes:
        transport: transport to the pixels of the places, for one specular lobe.
        metals: whether metallic may be greater than 0.
    """

    transport: Transport
    metals: bool

    def error(self, places: Places, fitted: Tensor, held_back: Tensor, typical: float) -> Float[Tensor, " P"]:
        """Fit to some pixels; the mean relative error of each place in the held-back ones."""
        fit = fit_places(
            places.where(fitted), self.transport[fitted], typical, self.metals, SCALE, rounds=ROUNDS
        )
        unknown = places.where(held_back)
        return unknown.mean(place_errors(fit, unknown, self.transport[held_back], typical))


@torch.no_grad()
def reduction_in_held_back_views(
    places: Places,
    typical: float,
    simple: Alternative,
    rich: Alternative,
    folds: int,
    turns: int,
    by: str,
    worth: float,
) -> Measurement:
    """Mean reduction of the relative error of the places by the richer alternative.

    Args:
        places: places in the training views, with linear radiance.
        typical: radiance of a typical pixel.
        simple: the alternative whose error is the reference.
        rich: the alternative that may reduce it.
        folds: number of folds of the views; one of them is held back at a time.
        turns: number of folds that are held back in turn.
        by: what distinguishes the richer alternative, for the description of the measurement.
        worth: reduction above which the richer alternative is used.
    """
    gains = []
    for turn in range(turns):
        is_held_back = places.view % folds == turn
        fitted, held_back = torch.nonzero(~is_held_back)[:, 0], torch.nonzero(is_held_back)[:, 0]
        before, after = (one.error(places, fitted, held_back, typical) for one in (simple, rich))
        has_views = torch.bincount(places.place[held_back], minlength=places.count) > 0
        gains.append(torch.where(has_views, before - after, torch.nan))
    gain = torch.stack(gains).nanmean(0)
    return mean_of(gain[gain.isfinite()], f"reduction of the error in held-back views by {by}", worth)
