"""Evidence for metals, measured at the places of the initial light, which are numerous enough to decide.

A dark glossy paint under a bright light looks like a metal in a single view. The change of a place from view
to view distinguishes the two, so places are fitted to most views with metals and without, and the fits are
compared in held-back views.

The mean over all places decides. At places without metal, a fit with metals uses them to compensate for other
errors, which increases the error in held-back views; if a tenth of the places are metal, their benefit
outweighs this. A mean over only those places that the fit classifies as metal would be misleading: if there
is little metal, most of them are classified wrongly.
"""

from __future__ import annotations

import torch

from neilfpp_method.effects.measurement import Measurement, mean_of
from neilfpp_method.effects.place_fit import fit_places, place_errors
from neilfpp_method.effects.places import Places
from neilfpp_method.lighting.transport import Transport

__all__ = ["metals_evidence"]

FOLDS = 5
"""Number of folds of the views; one fold is held back at a time."""
TURNS = 4
"""Number of folds that are held back in turn. With only one, the standard error would be as large as the
increase of the error that metals cause in a scene without metal.
"""
ROUNDS = 3
"""Alternations of light and material in a fit: half of the usual number distinguishes metal from paint
equally well.
"""
SCALE = 0.33
"""Mean base colour of both fits. The comparison does not depend on the scale of light and base colour."""
WORTH = 0.0
"""Threshold for the reduction of the relative error. Metals take no additional time, so they are left out
only if they increase the error.
"""


@torch.no_grad()
def metals_evidence(places: Places, transport: Transport, typical: float) -> Measurement:
    """Mean reduction of the relative error of the places by metals, in held-back views.

    Args:
        places: places in the training views, with linear radiance.
        transport: transport to the same pixels (`place_fit.place_transport`).
        typical: radiance of a typical pixel.
    """
    gains = []
    for turn in range(TURNS):
        is_held_back = places.view % FOLDS == turn
        fitted, held_back = torch.nonzero(~is_held_back)[:, 0], torch.nonzero(is_held_back)[:, 0]
        known, unknown = places.where(fitted), places.where(held_back)
        paint, metal = (
            fit_places(known, transport[fitted], typical, allowed, SCALE, rounds=ROUNDS)
            for allowed in (False, True)
        )
        errors = [
            unknown.mean(place_errors(fit, unknown, transport[held_back], typical)) for fit in (paint, metal)
        ]
        has_views = torch.bincount(unknown.place, minlength=places.count) > 0
        gains.append(torch.where(has_views, errors[0] - errors[1], torch.nan))
    gain = torch.stack(gains).nanmean(0)
    what = "reduction of the error in held-back views by metals"
    return mean_of(gain[gain.isfinite()], what, WORTH)
