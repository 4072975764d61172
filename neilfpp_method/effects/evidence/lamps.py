"""Evidence for the lamps of an initial light, from held-back views of surface places.

The light solver looks for lamps at points of which each has a single view. A lamp that compensates for the
painted colours of a region also explains held-back points of that region. Glossy surfaces, however, also
reflect a lamp as a highlight, which moves from view to view. The base colours of all places are therefore
fitted again together with the lamps, and the fits with and without lamps are compared in held-back views.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import torch

from neilfpp_method.effects.places.data import PlaceData, lamp_light
from neilfpp_method.effects.places.fit import PlaceFit, mean_errors
from neilfpp_method.effects.places.gathering import Split
from neilfpp_method.fields.lamps import Lamps
from neilfpp_method.lighting.fit import Evidence, evidence
from neilfpp_method.shading.brdf import Lobe
from neilfpp_method.structures import SceneTracer

__all__ = ["LampTrial"]


@dataclass(frozen=True)
class LampTrial:
    """A fit without lamps, and what is needed to repeat it with lamps.

    Attributes:
        split: the pixels of the fitted and of the held-back views, with the transport without lamps.
        refit: fits light and materials.
    """

    split: Split[PlaceData]
    refit: Callable[[PlaceData], PlaceFit]

    @torch.no_grad()
    def __call__(self, lamps: Lamps, lobe: Lobe, scene: SceneTracer | None) -> Evidence:
        """Mean reduction of the relative error of the places by lamps, in held-back views.

        Args:
            lamps: the lamps; their light is fixed, all other light and the materials are fitted again.
            lobe: the specular lobe.
            scene: traces shadow rays; None if inter-reflection is off.
        """
        known, held_back = (
            data.with_light(lamp_light(data.places, lamps, lobe, scene))
            for data in (self.split.known, self.split.held_back)
        )
        without = mean_errors(self.refit(self.split.known), self.split.held_back)
        gain = without - mean_errors(self.refit(known), held_back)
        return replace(evidence(gain[gain.isfinite()]), in_views=True)
