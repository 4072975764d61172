"""Evidence for the long tails of GGX: places that are fitted with it, with views kept back, against the same
places with the paper's spherical Gaussian.

The two agree about the middle of a highlight. GGX has a wide, faint glow about it, as most real surfaces do.
"""

from __future__ import annotations

import torch
from torch import Tensor

from neilfpp_method.effects.measurement import Measurement, mean_of
from neilfpp_method.effects.place_fit import fit_places, place_errors, place_transport
from neilfpp_method.effects.places import Places
from neilfpp_method.shading import LOBES
from neilfpp_method.shading.brdf import Lobe
from neilfpp_method.structures import SceneTracer

__all__ = ["lobe_evidence"]

PLACES = 400
"""How many are looked at."""
FOLDS = 4
"""Of the views one in so many is kept back."""
SCALE = 0.33
"""Mean base colour of both fits: the scale of light and base colour is no part of the question."""
WORTH = 0.0
"""Relative error that GGX must save: it costs nothing."""


@torch.no_grad()
def lobe_evidence(places: Places, scene: SceneTracer | None, typical: float, metals: bool) -> Measurement:
    """How much lower the relative error of kept-back pixels is with GGX than with the spherical Gaussian.

    Arguments as of `find_first_light`.
    """
    places = places.where(torch.nonzero(places.place < PLACES)[:, 0])
    back = places.view % FOLDS == 0
    fitted, kept_back = torch.nonzero(~back)[:, 0], torch.nonzero(back)[:, 0]
    known, unknown = places.where(fitted), places.where(kept_back)

    def errors(lobe: Lobe) -> Tensor:
        carried = place_transport(places, lobe, scene)
        fit = fit_places(known, carried[fitted], typical, metals, SCALE)
        return unknown.mean(place_errors(fit, unknown, carried[kept_back], typical))

    gain = errors(LOBES["spherical_gaussian"]) - errors(LOBES["ggx"])
    counts = torch.bincount(unknown.place, minlength=places.count) > 0
    return mean_of(gain[counts], "error that GGX saves over a spherical Gaussian in views kept back", WORTH)
