"""The light that arrives at surface points, and the part of the sphere that each share of it comes from."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from jaxtyping import Float, Int
from torch import Tensor

from neilfpp_method.fields.environment import EnvironmentLight
from neilfpp_method.inter_reflection import scene_light
from neilfpp_method.model import NeilfModel
from neilfpp_method.shading.frame import dot
from neilfpp_method.shading.rendering_equation import PDF_FLOOR
from neilfpp_method.shading.sampling import Technique, combine, cosine, specular_lobe, sphere_lattice
from neilfpp_method.structures import Indexable, Material, SceneLight

__all__ = ["PATCHES", "Arriving", "arriving_light", "by_patch", "patch_count"]

PATCHES = 32
"""Parts of the sphere, about 40° wide."""
DIRECTIONS = 24
"""Incident directions of each kind, by the cosine and towards the light; about as many follow the lobes."""
DIRECTIONS_PER_VIEW = 3


@dataclass(frozen=True)
class Arriving(Indexable):
    """Light that arrives at N points along S directions, times cosine and solid angle, and the patch that it comes from.

    Patches are the `PATCHES` parts of the sphere, for light from outside the scene; the same again, for light from its own
    surfaces; and one for each lamp.
    """

    wi: Float[Tensor, "N S 3"]
    light: Float[Tensor, "N S 3"]
    patch: Int[Tensor, "N S"]


@torch.no_grad()
def arriving_light(
    model: NeilfModel,
    position: Float[Tensor, "N 3"],
    normal: Float[Tensor, "N 3"],
    wo: Float[Tensor, "N V 3"],
    material: Material,
) -> Arriving:
    """Light along directions that serve all viewers of a point: each is asked and traced once, the same at every call."""
    light, lamps, lobe, hard = model.light, model.lamps, model.lobe, model.config.inter_reflection.mode == "hard"
    techniques = [(cosine(normal), DIRECTIONS)]
    if isinstance(light, EnvironmentLight):
        sky = Technique(lambda count, stochastic: light.sample(normal, count, stochastic).wi, light.pdf)
        techniques.append((sky, DIRECTIONS))
    if model.config.shading.specular:
        lobes = [specular_lobe(normal, direction, material.roughness, lobe) for direction in wo.unbind(1)]
        techniques += [(technique, DIRECTIONS_PER_VIEW) for technique in lobes]
    drawn = combine(techniques, stochastic=False)
    wi, weight = drawn.wi, dot(drawn.wi, normal).clamp_min(0) / drawn.pdf.clamp_min(PDF_FLOOR) / drawn.wi.shape[1]
    radiance, patch = light.radiance(position, wi), _nearest_patch(wi)
    if hard:
        scene = _scene(model, position, wi)
        radiance, patch = torch.where(scene.hit[..., None], scene.radiance, radiance), patch + PATCHES * scene.hit
    if lamps is not None and lamps.lit:
        rays = lamps.rays_from(position)
        shining = lamps.arriving(rays)
        if hard:
            shining = shining * (_scene(model, position, rays.wi).distance >= rays.distance)[..., None]
        number = 2 * PATCHES + torch.arange(lamps.lit, device=patch.device)
        wi, radiance, patch = _beside(wi, rays.wi), _beside(radiance, shining), _beside(patch, number.expand(len(patch), -1))
        weight = _beside(weight, dot(rays.wi, normal).clamp_min(0) * rays.solid_angle)
    return Arriving(wi, weight[..., None] * radiance, patch)


def _beside(a: Tensor, b: Tensor) -> Tensor:
    return torch.cat((a, b), 1)


def _scene(model: NeilfModel, position: Float[Tensor, "N 3"], wi: Float[Tensor, "N S 3"]) -> SceneLight:
    return scene_light(model.host, position, wi, model.config.inter_reflection, model.config.shading.hit_share)


def _nearest_patch(wi: Float[Tensor, "N S 3"]) -> Int[Tensor, "N S"]:
    """Patches are about the directions of a lattice over the sphere."""
    return (wi @ sphere_lattice(PATCHES, wi).to(wi).T).argmax(-1)


def patch_count(model: NeilfModel) -> int:
    """How many patches there are."""
    return 2 * PATCHES + (model.lamps.lit if model.lamps is not None else 0)


def by_patch(light: Float[Tensor, "N S 3"], patch: Int[Tensor, "N S"], patches: int) -> Float[Tensor, "N 3 K"]:
    """What each patch brings."""
    total = light.new_zeros(len(light), 3, patches)
    return total.scatter_add_(2, patch[:, None].expand(-1, 3, -1), light.mT)
