"""Evidence for the long tails of GGX: places that are fitted with it, with views kept back, against the same
places with the paper's spherical Gaussian.

The two agree about the middle of a highlight. GGX has a wide, faint glow about it, as most real surfaces do.
Metals show it best: all that they send is highlight. So where some places are taken for metal, only those
count.
"""

from __future__ import annotations

import torch

from neilfpp_method.effects.measurement import MIN_SAMPLES, Measurement, mean_of
from neilfpp_method.effects.place_fit import fit_places, place_errors, place_transport
from neilfpp_method.effects.places import Places
from neilfpp_method.shading import LOBES
from neilfpp_method.structures import SceneTracer

__all__ = ["lobe_evidence"]

PLACES = 700
"""How many are looked at."""
FOLDS, TURNS = 4, 2
"""Of the views one in four is kept back, in two of the four possible ways."""
METAL = 0.5
"""Metallic above which a place is taken for metal."""
SCALE = 0.33
"""Mean base colour of both fits: the scale of light and base colour is no part of the question."""
WORTH = 0.0
"""Relative error that GGX must save: any that is not chance, as it costs nothing."""


@torch.no_grad()
def lobe_evidence(places: Places, scene: SceneTracer | None, typical: float, metals: bool) -> Measurement:
    """How much lower the relative error of kept-back pixels is with GGX than with the spherical Gaussian.

    Arguments as of `find_first_light`.
    """
    places = places.where(torch.nonzero(places.place < PLACES)[:, 0])
    carried = [place_transport(places, LOBES[name], scene) for name in ("spherical_gaussian", "ggx")]
    gains, metal = [], []
    for turn in range(TURNS):
        back = places.view % FOLDS == turn
        fitted, kept_back = torch.nonzero(~back)[:, 0], torch.nonzero(back)[:, 0]
        known, unknown = places.where(fitted), places.where(kept_back)
        fits = [fit_places(known, part[fitted], typical, metals, SCALE) for part in carried]
        errors = [
            unknown.mean(place_errors(fit, unknown, part[kept_back], typical))
            for fit, part in zip(fits, carried, strict=True)
        ]
        shown = unknown.place.unique()
        gains.append((errors[0] - errors[1])[shown])
        metal.append(torch.stack([fit.material(shown).metallic[:, 0] > METAL for fit in fits]).any(0))
    gain, of_metal = torch.cat(gains), torch.cat(metal)
    if of_metal.sum() >= MIN_SAMPLES:
        gain = gain[of_metal]
    return mean_of(gain, "error that GGX saves over a spherical Gaussian in views kept back", WORTH)
