"""Places together with the light transport to their pixels: the data to which light and materials are fitted.

Because there are few places, the transport is stored as a matrix for each roughness of the grid.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import torch
from jaxtyping import Float
from torch import Tensor

from neilfpp_method.effects.places.gathering import Places, Split
from neilfpp_method.effects.places.grid import ROUGHNESSES
from neilfpp_method.fields.environment import EnvironmentLight
from neilfpp_method.fields.lamps import Lamps
from neilfpp_method.lighting.lamp_transport import in_sight
from neilfpp_method.lighting.layered_transport import lamp_layers, texel_layers
from neilfpp_method.lighting.transport import Transport
from neilfpp_method.shading.brdf import Lobe
from neilfpp_method.structures import SceneTracer

__all__ = ["PlaceData", "lamp_light", "place_transport"]

ROWS = 16
"""Rows of the map, whose texels are 11° high. Finer detail is left to training, which uses more pixels."""
DIRECTIONS = 4
"""Random directions per texel and pixel: a lobe of roughness 0.2 is narrower than a texel."""


@dataclass(frozen=True)
class PlaceData:
    """What a fit of light and materials explains.

    Attributes:
        places: places with their pixels, in linear radiance.
        transport: the transport to these pixels (`place_transport`).
        typical: radiance of a typical pixel.
        response: response of the capture from which the pixels come, "linear" or "srgb".
    """

    places: Places
    transport: Transport
    typical: float
    response: str

    def where(self, rows: Tensor) -> PlaceData:
        """The same places with only some of the pixels."""
        return PlaceData(self.places.where(rows), self.transport[rows], self.typical, self.response)

    def hold_back(self, fold: int, folds: int) -> Split[PlaceData]:
        """Hold back one fold of the views, which are numbered from 0 to `folds` − 1."""
        rows = self.places.fold_rows(fold, folds)
        return Split(self.where(rows.known), self.where(rows.held_back))

    def with_light(self, layers: Float[Tensor, "K N 3"]) -> PlaceData:
        """The same data with more light of known radiance, which is added to that of the scene."""
        return replace(self, transport=replace(self.transport, scene=self.transport.scene + layers))


@torch.no_grad()
def place_transport(places: Places, lobe: Lobe, scene: SceneTracer | None) -> Transport:
    """The transport from the texels of a map to N pixels, with the layers of `lighting.layered_transport`.

    It takes 21 kB per pixel. Rays are traced once per place.
    """
    environment = EnvironmentLight(ROWS, 1.0).to(places.place.device)
    shared = places.shared_points()
    drawn = (texel_layers(environment, shared, ROUGHNESSES, lobe, scene) for _ in range(DIRECTIONS))
    total = next(drawn)
    for part in drawn:
        # In place: a matrix may have hundreds of megabytes.
        total.sources.add_(part.sources)
        total.scene.add_(part.scene)
    return Transport(total.sources.div_(DIRECTIONS), total.scene.div_(DIRECTIONS))


@torch.no_grad()
def lamp_light(places: Places, lamps: Lamps, lobe: Lobe, scene: SceneTracer | None) -> Float[Tensor, "K N 3"]:
    """The layers of the N pixels of places that lamps cause, in radiance (`PlaceData.with_light`).

    Args:
        places: the places with their pixels.
        lamps: the lamps; the layers are proportional to their intensities.
        lobe: the specular lobe.
        scene: traces shadow rays; None if inter-reflection is off.
    """
    sight = in_sight(lamps.lit_places, lamps.radius, places.observed.position, scene)
    return lamp_layers(lamps, sight, places.observed, ROUGHNESSES, lobe)
