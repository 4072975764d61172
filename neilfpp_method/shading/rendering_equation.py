"""The estimator of the rendering equation, one for every sampler (METHOD §1)."""

from __future__ import annotations

import math

import torch
from jaxtyping import Float
from torch import Tensor

from neilfpp_method.shading.brdf import Lobe, brdf_terms, cosines, diffuse_reflectance, normal_reflectance
from neilfpp_method.shading.frame import at_least_float32, dot
from neilfpp_method.structures import Incident, Material, Shading

__all__ = ["shade"]


def shade(
    material: Material,
    n: Float[Tensor, "N 3"],
    wo: Float[Tensor, "N 3"],
    incident: Incident,
    lobe: Lobe | None,
) -> Shading:
    """Outgoing radiance L_o(wo) ≈ Σ weight f(wo, wi) L(wi) max(n·wi, 0), in at least float32.

    The colours of the BRDF do not depend on wi and are factored out of the sum: f has three scalar weights
    per direction, and the only tensors of shape (N, S, 3) that autograd stores are directions and radiance.

    Args:
        material: material of the points.
        n, wo: unit normals and unit directions to the viewer, away from the surface.
        incident: incident radiance with directions and weights.
        lobe: specular lobe; None: the surface is Lambertian.
    """
    radiance = at_least_float32(incident.radiance)
    weight = dot(incident.wi, n).clamp_min(0) * incident.weight

    reflectance = diffuse_reflectance(material, lobe is not None) / math.pi
    if lobe is None:
        diffuse = reflectance * _integrate(weight, radiance)
        return Shading(diffuse, diffuse, torch.zeros_like(diffuse))

    terms = brdf_terms(cosines(n, wo, incident.wi), material.roughness, lobe)
    scattered, facing, grazing = (
        _integrate(weight * term, radiance) for term in (terms.diffuse, terms.facing, terms.grazing)
    )
    diffuse = reflectance * scattered
    reflected = normal_reflectance(material) * facing + grazing
    return Shading(diffuse + reflected, diffuse, reflected)


def _integrate(weight: Float[Tensor, "N S"], radiance: Float[Tensor, "#N S 3"]) -> Float[Tensor, "N 3"]:
    """Σ weight · radiance over the directions; not a matmul, which autocast would do in half precision."""
    return (weight.unsqueeze(-1) * radiance).sum(1)
