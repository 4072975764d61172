"""Incident light at surface points, split by origin: a patch of the sphere of directions, or a lamp."""

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
"""Number of patches into which the sphere of directions is divided; each is about 40° wide."""


@dataclass(frozen=True)
class PatchLight(Indexable):
    """Incident light of N points along S directions, with the index of the patch it comes from.

    Attributes:
        wi: unit directions to the light.
        light: incident radiance times cosine and solid angle.
        patch: patch index. The first `PATCHES` indices are patches of the sphere for light from outside the
            scene; the next `PATCHES` are the same patches for light from surfaces of the scene; the others
            are lamps.
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
    """Evaluate the incident light along directions that all viewers of a point share. Deterministic.

    Each direction is traced once, however many viewers there are.
    """
    directions = directions_for_viewers(model.light, normal, wo, material.roughness, model.lobe)
    incident = arriving(model.sources, position, directions)
    weight = incident.weight * dot(incident.wi, normal).clamp_min(0)
    of_sphere = _nearest_patch(incident.wi) + PATCHES * (incident.source == Source.SCENE)
    of_lamp = 2 * PATCHES + incident.source - Source.LAMPS
    patch = torch.where(incident.source >= Source.LAMPS, of_lamp, of_sphere)
    return PatchLight(incident.wi, weight[..., None] * incident.radiance, patch)


def _nearest_patch(wi: Float[Tensor, "N S 3"]) -> Int[Tensor, "N S"]:
    """Index of the patch of each direction: the nearest of `PATCHES` lattice directions on the sphere."""
    return (wi @ sphere_lattice(PATCHES, wi).to(wi).T).argmax(-1)


def patch_count(model: NeilfModel) -> int:
    """Number of patches K of a model: two sets of `PATCHES`, and one for each lamp that is lit."""
    return 2 * PATCHES + model.lamps.count


def by_patch(
    light: Float[Tensor, "N S 3"], patch: Int[Tensor, "N S"], patches: int
) -> Float[Tensor, "N 3 K"]:
    """Sum light over the directions of each patch."""
    total = light.new_zeros(len(light), 3, patches)
    return total.scatter_add_(2, patch[:, None].expand(-1, 3, -1), light.mT)
