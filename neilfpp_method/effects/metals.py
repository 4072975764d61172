"""Evidence for metals, from the places of the initial light: many places tell what few leave open.

A dark glossy paint under a bright light explains one view of a metal. The change of a place from view to view
tells them apart, so places are fitted to most views with metals and without, and the fits are compared in
held-back views. Only places that the fit classifies as metal count: elsewhere the two agree.
"""

from __future__ import annotations

import torch

from neilfpp_method.effects.measurement import Measurement, mean_of
from neilfpp_method.effects.place_fit import fit_places, place_errors
from neilfpp_method.effects.places import Places
from neilfpp_method.lighting.transport import Transport

__all__ = ["metals_evidence"]

FOLDS = 5
"""Number of folds of the views; one of them is held back."""
SCALE = 0.33
"""Mean base colour of both fits. The comparison does not depend on the scale of light and base colour."""
METAL = 0.5
"""Metallic above which a place is classified as metal."""
WORTH = 0.01
"""Reduction of the relative error that metals must bring."""


@torch.no_grad()
def metals_evidence(places: Places, transport: Transport, typical: float) -> Measurement:
    """Reduction of the relative error of held-back pixels by metals, at places classified as metal.

    Args:
        places: places in the training views, with linear radiance.
        transport: transport to the same pixels (`place_fit.place_transport`).
        typical: radiance of a typical pixel.
    """
    is_held_back = places.view % FOLDS == 0
    fitted, held_back = torch.nonzero(~is_held_back)[:, 0], torch.nonzero(is_held_back)[:, 0]
    known, unknown = places.where(fitted), places.where(held_back)
    paint, metal = (
        fit_places(known, transport[fitted], typical, allowed, SCALE) for allowed in (False, True)
    )
    errors = [
        unknown.mean(place_errors(fit, unknown, transport[held_back], typical)) for fit in (paint, metal)
    ]
    numbers = unknown.place.unique()
    counted = numbers[metal.material(numbers).metallic[:, 0] > METAL]
    gain = (errors[0] - errors[1])[counted]
    return mean_of(
        gain, "reduction of the error in held-back views by metals, where there seem to be some", WORTH
    )
