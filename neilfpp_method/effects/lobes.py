"""Evidence for the long tails of GGX against the paper's spherical Gaussian.

Places are fitted with either lobe, and the fits are compared in held-back views. The two lobes agree in the
centre of a highlight; GGX also has wide, faint tails, as most real surfaces do.

All places count. The tails are most visible on metals, but the fits classify some paint as metal, and what
such places prefer says nothing about the lobe.
"""

from __future__ import annotations

import torch

from neilfpp_method.effects.measurement import Measurement, mean_of
from neilfpp_method.effects.place_fit import fit_places, place_errors, place_transport
from neilfpp_method.effects.places import Places
from neilfpp_method.shading import LOBES
from neilfpp_method.structures import SceneTracer

__all__ = ["lobe_evidence"]

FOLDS = 4
"""Number of folds of the views; one fold is held back at a time."""
ROUNDS = 3
"""Alternations of light and material in a fit: half of the usual number separate the lobes as well."""
SCALE = 0.33
"""Mean base colour of both fits. The comparison does not depend on the scale of light and base colour."""
WORTH = 0.0
"""Threshold for the reduction of the relative error by GGX: since GGX has no cost, any significant reduction
is enough.
"""


@torch.no_grad()
def lobe_evidence(places: Places, scene: SceneTracer | None, typical: float, metals: bool) -> Measurement:
    """Mean reduction of the relative error of the places by GGX against the Gaussian, in held-back views.

    Args:
        places: places in the training views, with linear radiance.
        scene: traces rays through the scene; None without inter-reflection.
        typical: radiance of a typical pixel.
        metals: whether metallic may be greater than 0.
    """
    transports = [place_transport(places, LOBES[name], scene) for name in ("spherical_gaussian", "ggx")]
    gains = []
    for turn in range(FOLDS):
        is_held_back = places.view % FOLDS == turn
        fitted, held_back = torch.nonzero(~is_held_back)[:, 0], torch.nonzero(is_held_back)[:, 0]
        known, unknown = places.where(fitted), places.where(held_back)
        errors = []
        for transport in transports:
            fit = fit_places(known, transport[fitted], typical, metals, SCALE, rounds=ROUNDS)
            errors.append(unknown.mean(place_errors(fit, unknown, transport[held_back], typical)))
        shown = torch.bincount(unknown.place, minlength=places.count) > 0
        gains.append(torch.where(shown, errors[0] - errors[1], torch.nan))
    gain = torch.stack(gains).nanmean(0)
    what = "reduction of the error in held-back views by GGX"
    return mean_of(gain[gain.isfinite()], what, WORTH)
