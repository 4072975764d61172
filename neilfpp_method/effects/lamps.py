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
from jaxtyping import Float
from torch import Tensor

from neilfpp_method.effects.material_grid import ROUGHNESSES
from neilfpp_method.effects.place_fit import PlaceFit, place_errors
from neilfpp_method.effects.places import Places
from neilfpp_method.fields.lamps import LampPlaces, Lamps
from neilfpp_method.lighting.fit import Evidence, evidence
from neilfpp_method.lighting.transport import Transport, in_sight, lamp_kernel
from neilfpp_method.shading.brdf import Lobe
from neilfpp_method.structures import Observed, SceneTracer

__all__ = ["LampTrial"]


@dataclass(frozen=True)
class LampTrial:
    """A fit without lamps, and what is needed to repeat it with lamps.

    Attributes:
        known: the pixels of the fitted views.
        transport: the transport to these pixels, without lamps.
        held_back: the pixels of the held-back views.
        held_back_transport: the transport to the held-back pixels.
        typical: radiance of a typical pixel.
        refit: fits light and materials to the known pixels, given their transport.
    """

    known: Places
    transport: Transport
    held_back: Places
    held_back_transport: Transport
    typical: float
    refit: Callable[[Transport], PlaceFit]

    @torch.no_grad()
    def __call__(self, lamps: Lamps, lobe: Lobe, scene: SceneTracer | None) -> Evidence:
        """Mean reduction of the relative error of the places by lamps, in held-back views.

        Args:
            lamps: the lamps; their light is fixed, all other light and the materials are fitted again.
            lobe: the specular lobe.
            scene: traces shadow rays; None if inter-reflection is off.
        """
        fitted, held_back = (
            replace(transport, scene=transport.scene + _lamp_light(lamps, places.observed, lobe, scene))
            for transport, places in (
                (self.transport, self.known),
                (self.held_back_transport, self.held_back),
            )
        )
        without = self._errors(self.refit(self.transport), self.held_back_transport)
        gain = without - self._errors(self.refit(fitted), held_back)
        return replace(evidence(gain[self.held_back.place.unique()]), in_views=True)

    def _errors(self, fit: PlaceFit, transport: Transport) -> Float[Tensor, " P"]:
        return self.held_back.mean(place_errors(fit, self.held_back, transport, self.typical))


def _lamp_light(
    lamps: Lamps, observed: Observed, lobe: Lobe, scene: SceneTracer | None
) -> Float[Tensor, "K N 3"]:
    """Light of the lamps via points, with the layers of `from_texels_at`."""
    places = LampPlaces(lamps.position[: lamps.count], lamps.axis[: lamps.count])
    sight = in_sight(places, lamps.radius, observed.position, scene)
    layers = []
    for number, value in enumerate(ROUGHNESSES):
        roughness = torch.full_like(observed.position[:, :1], value)
        kernel = lamp_kernel(places, lamps.radius, sight, observed, roughness, lobe)
        layers.append((kernel if number == 0 else kernel[1:]) @ lamps.intensity[: lamps.count])
    return torch.cat(layers)
