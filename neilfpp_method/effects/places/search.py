"""Search for paint at which training is stuck, under the current light.

Gradient descent cannot change a dark metal into a black paint: halfway between the two, the error is larger
than at both ends. Under the light of a half-trained model it is easy to see which of the two explains the
views better, so every roughness and metallic of a grid is tried at some thousand places. The BRDF field is
then trained to be paint where paint is better, and to keep its values everywhere else.

The roughness of paint can be stuck as well. The initial light has no lamps, and in a room with lamps it was
twice too strong. Paint that learned under it was rough, so that its highlights did not show, and stayed rough
when the light had its right scale: a slightly narrower highlight still does not resemble that of the images.

A rough metal reflects almost like matte paint, which is far more common. It also becomes paint if a metal is
only slightly better than paint. On photographs of a castle, half of the surface was rough metal otherwise.

Paint does not become metal: of 18 places of two scenes at which a search found metal in place of paint,
one was metal, whereas 87 % of the changes to paint were right.
"""

from __future__ import annotations

from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float
from torch import Tensor
from torch.nn import functional

from neilfpp_method.effects.places.grid import BestMaterials
from neilfpp_method.effects.places.lit import METAL, PAINT, LitPlaces
from neilfpp_method.fields.brdf import BrdfField
from neilfpp_method.fields.environment import EnvironmentLight
from neilfpp_method.model import NeilfModel
from neilfpp_method.schedule import Stage, StagePosition
from neilfpp_method.structures import Material

__all__ = [
    "SEARCH_AT",
    "SEARCH_SHARE",
    "SETTLED_AT",
    "SearchedMaterial",
    "found_in",
    "is_comparison_due",
    "is_search_due",
    "search_materials",
    "teach",
]

SEARCH_AT = (1 / 3, 2 / 3)
"""Shares of material init after which materials are searched."""
SETTLED_AT = 0.9
"""Share of material init after which only the scale is corrected, under a light that has settled since the
last correction. The training of the field on what a search finds would need more steps than are left.
"""
SEARCH_SHARE = 0.2
"""Time of a search as a share of that of the search for the initial light, with all its evidence, at the same
pixels (measured on `spot_city`: 22 of 105 s; on `tabletop_env` with fewer rays: 4 of 25 s).
"""
MAX_RATIO = 0.8
"""A material replaces that of the field if its error is at most this share of the error of the field."""
MIN_CHANGE = 0.5
"""Smallest decrease of metallic by which metal becomes paint. Smaller differences are not local optima, and
the field is more exact than the grid. A field whose metallic is less than this has paint there.
"""
MIN_ROUGHNESS_CHANGE = 0.3
"""Smallest change of log roughness by which paint gets another roughness: one to two steps of the grid."""
MIN_LOSS = 0.005
"""Loss of the field below which its material is kept: that of relative errors of 3 %, which the steps of the
grid cause as well.
"""
MIN_METAL_ROUGHNESS = 0.2
"""Metal that is smoother than this is kept: it mirrors more detail than a texel of the map and the grid of
roughness resolve, so the search would underrate it.
"""
MATTE_ROUGHNESS = 0.65
"""Roughness from which metal becomes paint even if another metal would be slightly better."""
MATTE_RATIO = 1.1
"""Largest error of that paint as a multiple of the error of the best material. At the end of training on
recovered geometry of `spot_city`, 17 of 18 such places were paint.
"""
STEPS = 150
"""Training steps of the field."""
BATCH = 4096
"""Points per training step of the field."""
RATE = 5e-3
"""Learning rate of the field."""


@dataclass(frozen=True)
class SearchedMaterial:
    """The material that the BRDF field should have at N points.

    Attributes:
        position: the points, scene frame.
        material: their material.
        share: share of the places at which it differs from that of the field.
    """

    position: Float[Tensor, "N 3"]
    material: Material
    share: float


def is_comparison_due(model: NeilfModel, position: StagePosition) -> bool:
    """Whether the materials of places are compared after `position.step` steps (`review.improve_material`).

    They never are if the light is not an environment map, or if the settings leave out highlights.
    """
    if model.lobe is None or not isinstance(model.light, EnvironmentLight):
        return False
    return position.stage is Stage.MATERIAL_INIT and _has_reached(position, (*SEARCH_AT, SETTLED_AT))


def is_search_due(position: StagePosition) -> bool:
    """Whether a comparison after `position.step` steps includes the search, and the review of metals."""
    return _has_reached(position, SEARCH_AT)


def _has_reached(position: StagePosition, shares: tuple[float, ...]) -> bool:
    """Whether one of these shares of the stage has just been reached."""
    return any(position.step - 1 < share * position.length <= position.step for share in shares)


@torch.no_grad()
def search_materials(brdf: BrdfField, lit: LitPlaces) -> SearchedMaterial:
    """Search for paint at which training is stuck, under the current light of a model.

    Args:
        brdf: gives the current materials.
        lit: places under the light of the model.

    Returns:
        Materials at the points that the pixels show.
    """
    current = brdf(lit.places.shared_points().position)
    loss, roughness, metallic = lit.loss(current), current.roughness[:, 0], current.metallic[:, 0]
    best = _paint_or_metal(lit, roughness) if brdf.metals else lit.best(PAINT)
    material = best.material
    is_better = (loss > MIN_LOSS) & (best.loss < MAX_RATIO * loss)
    was_metal = (metallic - material.metallic[:, 0] >= MIN_CHANGE) & (roughness >= MIN_METAL_ROUGHNESS)
    stays_paint = (metallic < MIN_CHANGE) & (best.metallic == 0)
    has_turned = (material.roughness[:, 0] / roughness).log().abs() >= MIN_ROUGHNESS_CHANGE
    was_stuck = stays_paint & has_turned & brdf.varying_roughness
    return found_in(lit, brdf, best, is_better & (was_metal | was_stuck))


def _paint_or_metal(lit: LitPlaces, roughness: Float[Tensor, " P"]) -> BestMaterials:
    """The best material of each place; where the field is rough, paint even if metal is slightly better."""
    paint, metal = lit.best(PAINT), lit.best(METAL)
    best = metal.where(metal.loss < paint.loss, paint)
    is_matte = (roughness >= MATTE_ROUGHNESS) & (paint.loss < MATTE_RATIO * best.loss)
    return best.where(~is_matte, paint)


@torch.no_grad()
def found_in(
    lit: LitPlaces, brdf: BrdfField, best: BestMaterials, is_found: Bool[Tensor, " P"]
) -> SearchedMaterial:
    """The materials of some places, and those of the field at all others."""
    place, position = lit.places.place, lit.places.observed.position
    material = _where(is_found[place], best.material[place], brdf(position))
    return SearchedMaterial(position, material, is_found.float().mean().item())


def _where(condition: Bool[Tensor, " N"], yes: Material, no: Material) -> Material:
    columns = ("base_color", "roughness", "metallic")
    return Material(*(torch.where(condition[:, None], getattr(yes, c), getattr(no, c)) for c in columns))


@torch.enable_grad()
def teach(brdf: BrdfField, searched: SearchedMaterial) -> None:
    """Train a BRDF field until it has the given material at the given points.

    Gradients that the field has already are kept.
    """
    gradients = [parameter.grad for parameter in brdf.parameters()]
    optimizer = torch.optim.Adam(brdf.parameters(), lr=RATE, betas=(0.9, 0.99))
    for _ in range(STEPS):
        rows = torch.randint(len(searched.position), (BATCH,), device=searched.position.device)
        material, target = brdf(searched.position[rows]), searched.material[rows]
        loss = sum(
            functional.mse_loss(getattr(material, name), getattr(target, name))
            for name in ("base_color", "roughness", "metallic")
        )
        optimizer.zero_grad(set_to_none=True)
        loss.backward()
        optimizer.step()
    for parameter, gradient in zip(brdf.parameters(), gradients, strict=True):
        parameter.grad = gradient
