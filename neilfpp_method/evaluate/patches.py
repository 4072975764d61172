"""Incident light at surface points, by its origin: part of the sphere, part of the scene, or lamp."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from jaxtyping import Float, Int
from torch import Tensor

from neilfpp_method.incident import arriving, directions_for_viewers
from neilfpp_method.model import NeilfModel
from neilfpp_method.shading.frame import dot
from neilfpp_method.shading.sampling import sphere_lattice
from neilfpp_method.structures import Indexable, Material, Source

__all__ = ["PATCHES", "PatchLight", "by_patch", "light_by_patch", "patch_count"]

PATCHES = 32
"""Parts that the sphere is divided into, each about 40° wide."""


@dataclass(frozen=True)
class PatchLight(Indexable):
    """Incident light of N points along S directions, times cosine and solid angle, with its patch.

    Patches are the `PATCHES` parts of the sphere, for light from outside the scene; the same again, for light
    from its own surfaces; and one for each lamp.
    """

    wi: Float[Tensor, "N S 3"]
    light: Float[Tensor, "N S 3"]
    patch: Int[Tensor, "N S"]


@torch.no_grad()
def light_by_patch(
    model: NeilfModel,
    position: Float[Tensor, "N 3"],
    normal: Float[Tensor, "N 3"],
    wo: Float[Tensor, "N V 3"],
    material: Material,
) -> PatchLight:
    """Light along directions shared by all viewers of a point: each is traced once, always the same."""
    drawn = directions_for_viewers(model.light, normal, wo, material.roughness, model.lobe)
    incident = arriving(model.sources, position, drawn)
    weight = incident.weight * dot(incident.wi, normal).clamp_min(0)
    of_sphere = _nearest_patch(incident.wi) + PATCHES * (incident.source == Source.SCENE)
    of_lamp = 2 * PATCHES + incident.source - Source.LAMPS
    patch = torch.where(incident.source >= Source.LAMPS, of_lamp, of_sphere)
    return PatchLight(incident.wi, weight[..., None] * incident.radiance, patch)


def _nearest_patch(wi: Float[Tensor, "N S 3"]) -> Int[Tensor, "N S"]:
    """Patches are about the directions of a lattice over the sphere."""
    return (wi @ sphere_lattice(PATCHES, wi).to(wi).T).argmax(-1)


def patch_count(model: NeilfModel) -> int:
    """How many patches there are."""
    return 2 * PATCHES + model.lamps.lit


def by_patch(
    light: Float[Tensor, "N S 3"], patch: Int[Tensor, "N S"], patches: int
) -> Float[Tensor, "N 3 K"]:
    """What each patch brings."""
    total = light.new_zeros(len(light), 3, patches)
    return total.scatter_add_(2, patch[:, None].expand(-1, 3, -1), light.mT)
