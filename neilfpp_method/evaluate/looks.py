"""Radiance that surface points send to their viewers by a model: as found, and with other materials."""

from __future__ import annotations

import math

import torch
from jaxtyping import Float
from torch import Tensor

from neilfpp_method.evaluate.patches import PatchLight, by_patch, patch_count
from neilfpp_method.evaluate.posterior import ROUGHNESS_NODES, Looks
from neilfpp_method.model import NeilfModel
from neilfpp_method.shading.brdf import Cosines, cosines, diffuse_reflectance, normal_reflectance
from neilfpp_method.structures import Material

__all__ = ["possible_looks", "sent_by_patch"]


@torch.no_grad()
def sent_by_patch(
    model: NeilfModel,
    incident: PatchLight,
    material: Material,
    normal: Float[Tensor, "N 3"],
    wo: Float[Tensor, "N V 3"],
) -> Float[Tensor, "N V 3 K"]:
    """The radiance that leaves each point towards each viewer, by the patch that it came from."""
    specular, patches = model.config.shading.specular, patch_count(model)
    kd, f0 = diffuse_reflectance(material, specular)[:, None], normal_reflectance(material)[:, None]
    sent = []
    for direction in wo.unbind(1):
        reflected = kd / math.pi
        if specular:
            cos = cosines(normal, direction, incident.wi)
            steep = _steepness(cos)[..., None]
            reflected = reflected + _lobe(model, cos, material.roughness)[..., None] * (
                f0 * (1 - steep) + steep
            )
        sent.append(by_patch(incident.light * reflected, incident.patch, patches))
    return torch.stack(sent, 1)


@torch.no_grad()
def possible_looks(
    model: NeilfModel, incident: PatchLight, normal: Float[Tensor, "N 3"], wo: Float[Tensor, "N V 3"]
) -> Looks:
    """What points would send whatever they are made of; no specular part where the model has none."""
    diffuse = incident.light.sum(1) / math.pi
    nodes = diffuse.new_tensor(ROUGHNESS_NODES)[:, None, None].expand(-1, len(diffuse), 1)
    facing = diffuse.new_zeros(len(diffuse), wo.shape[1], len(nodes), 3)
    grazing = torch.zeros_like(facing)
    for v, direction in enumerate(wo.unbind(1) if model.config.shading.specular else ()):
        cos = cosines(normal, direction, incident.wi)
        steep = _steepness(cos)[..., None]
        toward = torch.cat((incident.light * (1 - steep), incident.light * steep), -1)
        lobes = torch.stack([_lobe(model, cos, roughness) for roughness in nodes], 1)
        facing[:, v], grazing[:, v] = (lobes @ toward).split(3, -1)
    return Looks(diffuse, facing, grazing)


def _lobe(model: NeilfModel, cos: Cosines, roughness: Float[Tensor, "N 1"]) -> Float[Tensor, "N S"]:
    """D V of a microfacet lobe."""
    lobe = model.lobe
    return lobe.distribution(cos.h, roughness) * lobe.visibility(
        cos.i.clamp_min(0), cos.o.clamp_min(0), roughness
    )


def _steepness(cos: Cosines) -> Float[Tensor, "N S"]:
    """(1 − ωo·h)⁵ of Schlick's Fresnel term."""
    return (1 - cos.d).pow(5)
