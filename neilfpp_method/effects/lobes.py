"""Evidence for the long tails of GGX against the paper's spherical Gaussian.

Places are fitted with either lobe, and the fits are compared in held-back views. The two lobes agree in the
centre of a highlight; GGX also has wide, faint tails, as most real surfaces do. The tails are most visible on
metals, which reflect only specularly. So if enough places are classified as metal, only those count.
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
"""Maximum number of places."""
FOLDS = 4
"""Number of folds of the views; one fold is held back at a time."""
TURNS = 2
"""Number of folds that are held back in turn. Two of the four keep the time within bounds."""
METAL = 0.5
"""Metallic above which a place is classified as metal."""
SCALE = 0.33
"""Mean base colour of both fits. The comparison does not depend on the scale of light and base colour."""
WORTH = 0.0
"""Threshold for the reduction of the relative error by GGX: since GGX has no cost, any significant reduction
is enough.
"""


@torch.no_grad()
def lobe_evidence(places: Places, scene: SceneTracer | None, typical: float, metals: bool) -> Measurement:
    """Reduction of the relative error of held-back pixels by GGX against the spherical Gaussian.

    The arguments are those of `find_first_light`.
    """
    # Places are numbered in the order of random draws, so the first ones are a random subset.
    places = places.where(torch.nonzero(places.place < PLACES)[:, 0])
    transports = [place_transport(places, LOBES[name], scene) for name in ("spherical_gaussian", "ggx")]
    gains, metal = [], []
    for turn in range(TURNS):
        is_held_back = places.view % FOLDS == turn
        fitted, held_back = torch.nonzero(~is_held_back)[:, 0], torch.nonzero(is_held_back)[:, 0]
        known, unknown = places.where(fitted), places.where(held_back)
        fits = [fit_places(known, part[fitted], typical, metals, SCALE) for part in transports]
        errors = [
            unknown.mean(place_errors(fit, unknown, part[held_back], typical))
            for fit, part in zip(fits, transports, strict=True)
        ]
        numbers = unknown.place.unique()
        gains.append((errors[0] - errors[1])[numbers])
        metal.append(torch.stack([fit.material(numbers).metallic[:, 0] > METAL for fit in fits]).any(0))
    gain, is_metal = torch.cat(gains), torch.cat(metal)
    if is_metal.sum() >= MIN_SAMPLES:
        gain = gain[is_metal]
    return mean_of(gain, "reduction of the error in held-back views by GGX", WORTH)
