"""The estimator of the rendering equation, one for every sampler (METHOD §1)."""

from __future__ import annotations

import math

import torch
from jaxtyping import Float
from torch import Tensor

from neilfpp_method.shading.brdf import Lobe, diffuse_reflectance, normal_reflectance, specular_terms
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
    """L_o(wo) ≈ Σ weight f(wo, wi) L(wi) max(n·wi, 0), in at least float32.

    The colour of a surface does not depend on the direction, so it leaves the sum: three scalar weights per
    direction stand for f, and of tensors (N, S, 3) autograd keeps the directions and the radiance alone. `n`,
    `wo` are unit and point away from the surface. Without a `lobe` the surface is Lambertian and nothing
    specular is computed.
    """
    radiance = at_least_float32(incident.radiance)
    weight = dot(incident.wi, n).clamp_min(0) * incident.weight

    diffuse = diffuse_reflectance(material, lobe is not None) / math.pi * _integrate(weight, radiance)
    if lobe is None:
        return Shading(diffuse, diffuse, torch.zeros_like(diffuse))

    terms = specular_terms(material.roughness, n, wo, incident.wi, lobe)
    facing, grazing = (
        _integrate(weight * terms.facing, radiance),
        _integrate(weight * terms.grazing, radiance),
    )
    reflected = normal_reflectance(material) * facing + grazing
    return Shading(diffuse + reflected, diffuse, reflected)


def _integrate(weight: Float[Tensor, "N S"], radiance: Float[Tensor, "#N S 3"]) -> Float[Tensor, "N 3"]:
    """Σ weight · radiance over the directions; as a matmul, autocast would do it in half precision."""
    return (weight.unsqueeze(-1) * radiance).sum(1)
