"""Outgoing radiance of surface points towards their viewers, for the estimated material and for any other."""

from __future__ import annotations

import math

import torch
from jaxtyping import Float
from torch import Tensor

from neilfpp_method.evaluate.patches import PatchLight, by_patch, patch_count
from neilfpp_method.evaluate.posterior import ROUGHNESS_NODES, RadianceParts
from neilfpp_method.model import NeilfModel
from neilfpp_method.shading.brdf import Cosines, cosines, diffuse_reflectance, normal_reflectance
from neilfpp_method.structures import Material

__all__ = ["radiance_parts", "sent_by_patch"]


@torch.no_grad()
def sent_by_patch(
    model: NeilfModel,
    incident: PatchLight,
    material: Material,
    normal: Float[Tensor, "N 3"],
    wo: Float[Tensor, "N V 3"],
) -> Float[Tensor, "N V 3 K"]:
    """Compute the radiance that leaves each point towards each viewer, split by the patch it came from.

    Args:
        model: supplies the BRDF lobe and the number of patches K.
        incident: light that arrives at the N points.
        material: material of the points.
        normal: unit normals.
        wo: unit directions to V viewers.

    Returns:
        Linear radiance; the sum over the last axis is the outgoing radiance.
    """
    specular, patches = model.config.shading.specular, patch_count(model)
    kd, f0 = diffuse_reflectance(material, specular)[:, None], normal_reflectance(material)[:, None]
    sent = []
    for direction in wo.unbind(1):
        reflected = kd / math.pi
        if specular:
            cos = cosines(normal, direction, incident.wi)
            reflected = reflected * _diffuse(model, cos, material.roughness)[..., None]
            schlick = _schlick(cos)[..., None]
            fresnel = f0 * (1 - schlick) + schlick
            reflected = reflected + _lobe(model, cos, material.roughness)[..., None] * fresnel
        sent.append(by_patch(incident.light * reflected, incident.patch, patches))
    return torch.stack(sent, 1)


@torch.no_grad()
def radiance_parts(
    model: NeilfModel, incident: PatchLight, normal: Float[Tensor, "N 3"], wo: Float[Tensor, "N V 3"]
) -> RadianceParts:
    """Compute the parts from which `posterior` composes the outgoing radiance for any material.

    The specular parts are zero if the model's shading is Lambertian.
    """
    points, views, nodes = len(wo), wo.shape[1], len(ROUGHNESS_NODES)
    diffuse = (incident.light.sum(1) / math.pi)[:, None, None].repeat(1, views, nodes, 1)
    facing, grazing = torch.zeros_like(diffuse), torch.zeros_like(diffuse)
    roughnesses = diffuse.new_tensor(ROUGHNESS_NODES)[:, None, None].expand(-1, points, 1)
    for v, direction in enumerate(wo.unbind(1) if model.config.shading.specular else ()):
        cos = cosines(normal, direction, incident.wi)
        schlick = _schlick(cos)[..., None]
        light = torch.cat((incident.light * (1 - schlick), incident.light * schlick), -1)
        lobes = torch.stack([_lobe(model, cos, roughness) for roughness in roughnesses], 1)
        facing[:, v], grazing[:, v] = (lobes @ light).split(3, -1)
        if model.lobe.diffuse is not None:
            scattered = torch.stack([model.lobe.diffuse(cos, roughness) for roughness in roughnesses], 1)
            diffuse[:, v] = scattered @ incident.light / math.pi
    return RadianceParts(diffuse, facing, grazing)


def _diffuse(model: NeilfModel, cos: Cosines, roughness: Float[Tensor, "N 1"]) -> Float[Tensor, "N S"]:
    """The diffuse lobe relative to Lambert's."""
    return torch.ones_like(cos.i) if model.lobe.diffuse is None else model.lobe.diffuse(cos, roughness)


def _lobe(model: NeilfModel, cos: Cosines, roughness: Float[Tensor, "N 1"]) -> Float[Tensor, "N S"]:
    """Microfacet distribution times visibility term, D V."""
    distribution = model.lobe.distribution(cos.h, roughness)
    return distribution * model.lobe.visibility(cos.i.clamp_min(0), cos.o.clamp_min(0), roughness)


def _schlick(cos: Cosines) -> Float[Tensor, "N S"]:
    """(1 − ωo·h)⁵ of Schlick's Fresnel term."""
    return (1 - cos.d).pow(5)
