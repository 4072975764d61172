"""Places under the light of a half-trained model, which is held fixed: the best material for each of them."""

from __future__ import annotations

from dataclasses import dataclass, replace

import torch
from jaxtyping import Float, Int
from torch import Tensor

from neilfpp_method.effects.places.gathering import Places, Split
from neilfpp_method.effects.places.grid import (
    METALLICS,
    ROUGHNESSES,
    BestMaterials,
    best_materials,
    mean_loss,
    neighbors,
    relative_error,
)
from neilfpp_method.fields.light import LightModel
from neilfpp_method.lighting.layered_transport import LightLayers, layers_at, light_layers
from neilfpp_method.lighting.objective import DARK_FLOOR
from neilfpp_method.lighting.transport import outgoing_radiance
from neilfpp_method.model import NeilfModel
from neilfpp_method.shading.brdf import Lobe
from neilfpp_method.structures import Material

__all__ = ["METAL", "PAINT", "PAINT_OR_METAL", "LitPlaces", "light_up", "neighbor_count", "with_lobe"]

PAINT, METAL = range(1), range(1, len(METALLICS))
"""Indices in `METALLICS` of paint and of everything that is metallic."""
PAINT_OR_METAL = range(0, len(METALLICS), len(METALLICS) - 1)
"""Indices in `METALLICS` of 0 and 1. Values in between can make up for errors of the lobe or of the light."""
NEIGHBOR_PIXELS = 150
"""Number of pixels whose errors are added when the material of a place is chosen: those of the place and of
its nearest places. An attached loop has few pixels of each place, so it needs more places.
"""
MAX_NEIGHBORS_SHARE = 1 / 100
"""Largest number of those places, as a share of all places. A larger part of the object is often of several
materials.
"""
COLOR_SCALE = 0.2
"""Distance in scene units that counts as much as a factor e of base colour when neighbours are chosen: places
of the same look are often of one material.
"""
MIN_ROUGHNESS = 0.05
"""Roughnesses are raised to at least this value before they are rounded to the grid in log roughness."""


@dataclass(frozen=True)
class LitPlaces:
    """P places whose N pixels are explained under a fixed light.

    Attributes:
        places: the places with their pixels, in linear radiance.
        layers: the layers of L_o of each pixel that this light and the scene cause.
        near: indices of the neighbours of each place, including itself.
        typical: radiance of a typical pixel.
        seed: seed of the random directions from which the layers were computed.
    """

    places: Places
    layers: LightLayers
    near: Int[Tensor, "P M"]
    typical: float
    seed: int

    @property
    def parts(self) -> Float[Tensor, "K N 3"]:
        """The layers of L_o of each pixel."""
        return self.layers.light + self.layers.scene

    def dimmed(self, factor: float) -> LitPlaces:
        """The same places under a light that is weaker by this factor; the radiance of the scene is kept."""
        return replace(self, layers=LightLayers(self.layers.light / factor, self.layers.scene))

    def where(self, rows: Int[Tensor, " R"]) -> LitPlaces:
        """The same places with only some of the pixels."""
        layers = LightLayers(self.layers.light[:, rows], self.layers.scene[:, rows])
        return replace(self, places=self.places.where(rows), layers=layers)

    def hold_back(self, fold: int, folds: int) -> Split[LitPlaces]:
        """Hold back one fold of the views, which are numbered from 0 to `folds` − 1."""
        rows = self.places.fold_rows(fold, folds)
        return Split(self.where(rows.known), self.where(rows.held_back))

    def best(self, metallics: range) -> BestMaterials:
        """The material of each place that explains the pixels best, such as the best `PAINT`."""
        return best_materials(self.parts, self.places, self.typical, metallics, self.near)

    def error(self, material: Material) -> Float[Tensor, "N 3"]:
        """Relative error of each pixel if the places have this material, with roughness of the grid."""
        grid = torch.tensor(ROUGHNESSES, device=self.near.device).log()
        number = (material.roughness.clamp_min(MIN_ROUGHNESS).log() - grid).abs().argmin(1)
        parts = layers_at(self.parts, number[self.places.place], len(grid))
        outgoing = outgoing_radiance(parts, material[self.places.place])
        return relative_error(outgoing, self.places, self.typical)

    def mean_errors(self, material: Material) -> Float[Tensor, " P"]:
        """Mean relative error of the pixels of each place, clipped at 1; NaN for a place without pixels."""
        return self.places.mean_if_shown(self.error(material).abs().clamp_max(1).mean(-1))

    def loss(self, material: Material) -> Float[Tensor, " P"]:
        """The loss of `best_materials` for given materials."""
        return mean_loss(self.error(material), self.places, self.near)


def neighbor_count(places: int, pixels: int) -> int:
    """Number of places whose errors decide on the material of a place: itself and its nearest ones.

    Args:
        places: number of all places.
        pixels: number of pixels of all places together.
    """
    return max(1, int(places * min(NEIGHBOR_PIXELS / pixels, MAX_NEIGHBORS_SHARE)))


@torch.no_grad()
def light_up(model: NeilfModel, places: Places) -> LitPlaces:
    """Trace the light of a model, which has an environment map, to the pixels of places.

    Args:
        model: gives the light, the scene, the lobe, and the base colours by which neighbours are chosen.
        places: places with their pixels in the training views, in linear radiance. Those without pixels are
            left out of the result.
    """
    places, seed = places.only_shown(), int(torch.randint(2**31, ()))
    position = places.shared_points().position
    look = COLOR_SCALE * model.brdf(position).base_color.clamp_min(DARK_FLOOR).log()
    count = neighbor_count(places.count, len(places.place))
    near = neighbors(torch.cat((position, look), -1), count)
    layers = _layers(model, places, model.lobe, seed)
    return LitPlaces(places, layers, near, model.facts.median_radiance, seed)


@torch.no_grad()
def with_lobe(model: NeilfModel, lit: LitPlaces, lobe: Lobe) -> LitPlaces:
    """The same places with another lobe, under the light that the model has now.

    The random directions are the same, so their noise cancels when two lobes are compared.
    """
    return replace(lit, layers=_layers(model, lit.places, lobe, lit.seed))


def _layers(model: NeilfModel, places: Places, lobe: Lobe, seed: int) -> LightLayers:
    """The layers of the pixels under the light of a model, from random directions of this seed."""
    with torch.random.fork_rng():
        torch.manual_seed(seed)
        light = LightModel(model.light, model.lamps)
        return light_layers(light, places.observed, ROUGHNESSES, lobe, model.scene)
