"""Evidence for the long tails of GGX against the paper's spherical Gaussian.

Places are fitted with either lobe, and the fits are compared in held-back views. The two lobes agree in the
centre of a highlight; GGX also has wide, faint tails, as most real surfaces do.

All places count. The tails are most visible on metals, but the fits classify some paint as metal, and what
such places prefer says nothing about the lobe.
"""

from __future__ import annotations

from neilfpp_method.effects.evidence.alternatives import Alternative, reduction_in_held_back_views
from neilfpp_method.effects.measurement import Measurement
from neilfpp_method.effects.places.data import PlaceData, place_transport
from neilfpp_method.effects.places.gathering import Places
from neilfpp_method.settings.facts import SceneFacts
from neilfpp_method.shading import LOBES
from neilfpp_method.structures import SceneTracer

__all__ = ["lobe_evidence"]

FOLDS = 4
"""Number of folds of the views; every fold is held back in turn."""
THRESHOLD = 0.0
"""Threshold for the reduction of the relative error by GGX: since GGX has no cost, any significant reduction
is enough.
"""


def lobe_evidence(places: Places, scene: SceneTracer | None, facts: SceneFacts, metals: bool) -> Measurement:
    """Mean reduction of the relative error of the places by GGX against the Gaussian, in held-back views.

    Args:
        places: places in the training views, with linear radiance.
        scene: traces rays through the scene; None without inter-reflection.
        facts: what was measured in the images.
        metals: whether metallic may be greater than 0.
    """

    def alternative(lobe: str) -> Alternative:
        transport = place_transport(places, LOBES[lobe], scene)
        return Alternative(PlaceData(places, transport, facts.median_radiance, facts.response), metals)

    gaussian, ggx = alternative("spherical_gaussian"), alternative("ggx")
    return reduction_in_held_back_views(gaussian, ggx, FOLDS, FOLDS, "GGX", THRESHOLD)
