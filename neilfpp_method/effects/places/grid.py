"""A grid of roughness and metallic, and the best material of it for each place under a fixed light."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor
from torch.nn import functional

from neilfpp_method.effects.places.gathering import Places
from neilfpp_method.lighting.layered_transport import layers_of
from neilfpp_method.lighting.objective import ERROR_FLOOR, OUTLIER_ERROR
from neilfpp_method.shading.brdf import DIELECTRIC_F0
from neilfpp_method.structures import Material

__all__ = [
    "METALLICS",
    "MIN_BASE_COLOR",
    "ROUGHNESSES",
    "BestMaterials",
    "best_materials",
    "mean_loss",
    "neighbors",
    "on_grid",
    "relative_error",
]

ROUGHNESSES = (0.08, 0.14, 0.2, 0.28, 0.36, 0.45, 0.55, 0.66, 0.8, 1.0)
"""Grid of roughness. The width of the lobe changes by about a half from one value to the next."""
METALLICS = (0.0, 0.2, 0.4, 0.6, 0.8, 1.0)
"""Grid of metallic."""
REWEIGHTED_ITERATIONS = 4
"""Iterations of reweighted least squares for the base colour."""
MIN_BASE_COLOR = 0.01
"""Smallest base colour, so that its logarithm is finite."""


@dataclass(frozen=True)
class BestMaterials:
    """The materials of P places that explain their pixels best under a fixed light.

    Attributes:
        base_color: base colour of each place.
        roughness: roughness of each place, as an index in `ROUGHNESSES`.
        metallic: metallic of each place, as an index in `METALLICS`.
        loss: mean loss of the pixels of each place and its neighbours.
    """

    base_color: Float[Tensor, "P 3"]
    roughness: Int[Tensor, " P"]
    metallic: Int[Tensor, " P"]
    loss: Float[Tensor, " P"]

    @property
    def material(self) -> Material:
        """The materials with the values of the grids."""
        return on_grid(self.base_color, self.roughness, self.metallic)

    def where(self, keep: Bool[Tensor, " P"], other: BestMaterials) -> BestMaterials:
        """These materials at the places to keep, and the other ones elsewhere."""
        return BestMaterials(
            torch.where(keep[:, None], self.base_color, other.base_color),
            torch.where(keep, self.roughness, other.roughness),
            torch.where(keep, self.metallic, other.metallic),
            torch.where(keep, self.loss, other.loss),
        )


def on_grid(
    base_color: Float[Tensor, "N 3"], roughness: Int[Tensor, " N"], metallic: Int[Tensor, " N"]
) -> Material:
    """The material with these indices in `ROUGHNESSES` and `METALLICS`."""
    values = [
        torch.tensor(grid, device=index.device)[index][:, None]
        for grid, index in ((ROUGHNESSES, roughness), (METALLICS, metallic))
    ]
    return Material(base_color, *values)


def neighbors(features: Float[Tensor, "P F"], count: int) -> Int[Tensor, "P M"]:
    """Indices of the `count` nearest places of each place, including itself."""
    return torch.cdist(features, features).topk(count, largest=False).indices


def relative_error(outgoing: Float[Tensor, "N 3"], places: Places, typical: float) -> Float[Tensor, "N 3"]:
    """Error of rendered pixels relative to the recorded ones."""
    pixel = places.observed.pixel
    return (outgoing - pixel) / (pixel + ERROR_FLOOR * typical)


@torch.no_grad()
def best_materials(
    parts: Float[Tensor, "K N 3"],
    places: Places,
    typical: float,
    metallics: range,
    near: Int[Tensor, "P M"],
) -> BestMaterials:
    """Choose the material of each place from all pairs of the grids, under a fixed light.

    For each pair of roughness and metallic, the base colour of a place is the best one by iteratively
    reweighted least squares; outgoing radiance is linear in it. The pair with the smallest error at the place
    and its neighbours is chosen.

    Args:
        parts: the parts of L_o of each pixel under the light (`lighting.layered_transport`).
        places: the places with their pixels, in linear radiance.
        typical: radiance of a typical pixel.
        metallics: indices in `METALLICS` of the values that are tried.
        near: indices of the neighbours of each place, including itself (`neighbors`).
    """
    unit = places.observed.pixel + ERROR_FLOOR * typical
    first = torch.zeros(places.count, dtype=torch.long, device=unit.device)
    base_color = torch.full((places.count, 3), MIN_BASE_COLOR, device=unit.device)
    best = BestMaterials(base_color, first, first, torch.full_like(base_color[:, 0], torch.inf))
    for k in range(len(ROUGHNESSES)):
        diffuse, facing, grazing = (parts[i] for i in layers_of(k, len(parts), len(ROUGHNESSES)))
        for j in metallics:
            m = METALLICS[j]
            # The relative error of a pixel is base_color · slope − target.
            slope = ((1 - m) * diffuse + m * facing) / unit
            target = (places.observed.pixel - DIELECTRIC_F0 * (1 - m) * facing - grazing) / unit
            weight = torch.ones_like(slope)
            for _ in range(REWEIGHTED_ITERATIONS):
                squares = places.mean(weight * slope.square()).clamp_min(1e-12)
                candidate = (places.mean(weight * slope * target) / squares).clamp(MIN_BASE_COLOR, 1)
                error = candidate[places.place] * slope - target
                weight = 1 / error.abs().clamp_min(OUTLIER_ERROR)
            loss = mean_loss(error, places, near)
            numbers = torch.full_like(best.roughness, k), torch.full_like(best.roughness, j)
            best = best.where(~(loss < best.loss), BestMaterials(candidate, *numbers, loss))
    return best


def mean_loss(error: Float[Tensor, "N 3"], places: Places, near: Int[Tensor, "P M"]) -> Float[Tensor, " P"]:
    """Mean Huber loss of the relative errors of all pixels of each place and its neighbours."""
    zero = torch.zeros_like(error)
    loss = functional.smooth_l1_loss(error, zero, beta=OUTLIER_ERROR, reduction="none").mean(-1)
    pixels = torch.bincount(places.place, minlength=places.count).to(loss.dtype)
    return (pixels * places.mean(loss))[near].sum(1) / pixels[near].sum(1).clamp_min(1)
