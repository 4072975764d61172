"""Search for paint at which training is stuck, under the current light.

Gradient descent cannot change a dark metal into a black paint: halfway between the two, the error is larger
than at both ends. Under the light of a half-trained model it is easy to see which of the two explains the
views better, so every roughness and metallic of a grid is tried at some thousand places. The BRDF field is
then trained to be paint where paint is better, and to keep its values everywhere else.

A rough metal reflects almost like matte paint, which is far more common. It also becomes paint if a metal is
only slightly better than paint. On photographs of a castle, half of the surface was rough metal otherwise.

The roughness of paint can be stuck as well. While the first light is inexact, paint may become so rough that
its highlights do not show, and its base colour shows them instead. A slightly narrower highlight then does
not lower the error. The grid is coarse, so that it contradicts the field at a few places of every scene; only
if it does at many of them is training stuck.

Paint does not become metal: of 18 places of two scenes at which a search found metal in place of paint,
one was metal, whereas 87 % of the changes to paint were right.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from enum import Enum

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
    "COMPARISONS",
    "SEARCH_SHARE",
    "Comparison",
    "SearchedMaterial",
    "comparison_due",
    "found_in",
    "is_comparable",
    "search_materials",
    "teach",
]


class Comparison(Enum):
    """What is compared at places under the light of a half-trained model."""

    SCALE = "scale"
    """The scale of light and base colour (`places.rescaling`)."""
    MATERIAL = "material"
    """The scale, materials at which training is stuck, and effects."""


COMPARISONS: Mapping[float, Comparison] = {
    1 / 3: Comparison.MATERIAL,
    2 / 3: Comparison.MATERIAL,
    0.9: Comparison.SCALE,
}
"""What is compared after which shares of material init. At nine tenths the light has settled since the last
correction, but too few steps are left to train the field on what a search finds.
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
MIN_STUCK_SHARE = 0.15
"""Minimum share of stuck places for which the roughness of paint is changed. On `tabletop_env`, where it is
learned well, the grid contradicts 2 to 4 % of the places, and changes there cost 1.8 dB of roughness. In the
corner of a room with two lamps it contradicted 29 %, whose paint was indeed too rough.
"""
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
"""Initial learning rate of the field. It falls linearly to 0, so that noise of single places averages out."""


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


def is_comparable(model: NeilfModel) -> bool:
    """Whether materials can be compared at places: under an environment map, and with highlights."""
    return model.lobe is not None and isinstance(model.light, EnvironmentLight)


def comparison_due(model: NeilfModel, position: StagePosition) -> Comparison | None:
    """What is compared after `position.step` steps of a stage (`review.improve_material`), or None."""
    if not is_comparable(model) or position.stage is not Stage.MATERIAL_INIT:
        return None
    reached = [c for share, c in COMPARISONS.items() if _has_reached(position, share)]
    return reached[-1] if reached else None


def _has_reached(position: StagePosition, share: float) -> bool:
    """Whether this share of the stage has just been reached."""
    return position.step - 1 < share * position.length <= position.step


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
    is_better = (loss > MIN_LOSS) & (best.loss < MAX_RATIO * loss)
    was_metal = (metallic - best.material.metallic[:, 0] >= MIN_CHANGE) & (roughness >= MIN_METAL_ROUGHNESS)
    is_paint = (metallic < MIN_CHANGE) & (best.metallic == 0)
    turned = (best.material.roughness[:, 0] / roughness).log().abs() >= MIN_ROUGHNESS_CHANGE
    is_stuck = is_better & is_paint & turned
    if not brdf.varying_roughness or is_stuck.float().mean() < MIN_STUCK_SHARE:
        is_stuck = torch.zeros_like(is_stuck)
    return found_in(lit, brdf, best, (is_better & was_metal) | is_stuck)


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
    schedule = torch.optim.lr_scheduler.LinearLR(
        optimizer, start_factor=1.0, end_factor=0.0, total_iters=STEPS
    )
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
        schedule.step()
    for parameter, gradient in zip(brdf.parameters(), gradients, strict=True):
        parameter.grad = gradient
