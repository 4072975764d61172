"""Outgoing radiance of surface points towards their viewers, for the estimated material and for any other."""

from __future__ import annotations

import math

import torch
from jaxtyping import Float
from torch import Tensor

from neilfpp_method.evaluate.patches import PatchLight, by_patch, patch_count
from neilfpp_method.evaluate.posterior import ROUGHNESS_NODES, RadianceParts
from neilfpp_method.model import NeilfModel
from neilfpp_method.shading.brdf import brdf_terms, cosines, evaluate
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
    sent = []
    for direction in wo.unbind(1):
        brdf = evaluate(material, normal, direction, incident.wi, model.lobe, specular)
        reflected = incident.light * (brdf.diffuse + brdf.specular)
        sent.append(by_patch(reflected, incident.patch, patches))
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
    if model.config.shading.specular:
        roughnesses = diffuse.new_tensor(ROUGHNESS_NODES)[:, None, None].expand(-1, points, 1)
        for v, direction in enumerate(wo.unbind(1)):
            cos = cosines(normal, direction, incident.wi)
            terms = [brdf_terms(cos, roughness, model.lobe) for roughness in roughnesses]
            diffuse[:, v] = torch.stack([term.diffuse for term in terms], 1) @ incident.light / math.pi
            facing[:, v] = torch.stack([term.facing for term in terms], 1) @ incident.light
            grazing[:, v] = torch.stack([term.grazing for term in terms], 1) @ incident.light
    return RadianceParts(diffuse, facing, grazing)
