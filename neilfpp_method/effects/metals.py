"""Evidence for metals, measured at the places of the initial light, which are numerous enough to decide.

A dark glossy paint under a bright light looks like a metal in a single view. The change of a place from view
to view distinguishes the two, so places are fitted to most views with metals and without, and the fits are
compared in held-back views.

The mean over all places decides. At places without metal, a fit with metals uses them to compensate for other
errors, which increases the error in held-back views; if a tenth of the places are metal, their benefit
outweighs this. A mean over only those places that the fit classifies as metal would be misleading: if there
is little metal, most of them are classified wrongly.

Photographs deviate from the model by more than renderings do: by tone curves, inaccurate poses and the depth
of field. Metals compensate for some of this in held-back views, too. So display values need a larger benefit.
"""

from __future__ import annotations

from neilfpp_method.effects.alternatives import Alternative, reduction_in_held_back_views
from neilfpp_method.effects.measurement import Measurement
from neilfpp_method.effects.place_data import PlaceData

__all__ = ["metals_evidence"]

FOLDS = 5
"""Number of folds of the views; one fold is held back at a time."""
TURNS = 4
"""Number of folds that are held back in turn. With only one, the standard error would be as large as the
increase of the error that metals cause in a scene without metal.
"""
WORTH = 0.0
"""Threshold for the reduction of the relative error. Metals take no additional time, so they are left out
only if they increase the error.
"""
WORTH_IN_DISPLAY_VALUES = 0.035
"""The same for images with display values. Three captures of photographs without metal had reductions of 1.5
to 2.3 %; an object of which a third is metal had 5 % after a tone curve (docs/effects.md).
"""


def metals_evidence(data: PlaceData, response: str) -> Measurement:
    """Mean reduction of the relative error of the places by metals, in held-back views.

    Args:
        data: the places.
        response: meaning of the pixel values of the capture, as in `SceneFacts`.
    """
    worth = WORTH_IN_DISPLAY_VALUES if response == "srgb" else WORTH
    paint, metal = Alternative(data, metals=False), Alternative(data, metals=True)
    return reduction_in_held_back_views(paint, metal, FOLDS, TURNS, "metals", worth)
