"""Directional albedo: radiance of a surface towards a viewer under a radiance of 1 from all directions."""

from __future__ import annotations

import math
from collections.abc import Callable
from functools import lru_cache

import torch
from jaxtyping import Float
from torch import Tensor
from torch.nn import functional

from neilfpp_method.shading.brdf import (
    BrdfTerms,
    Lobe,
    brdf_terms,
    cosines,
    diffuse_reflectance,
    normal_reflectance,
)
from neilfpp_method.shading.frame import dot
from neilfpp_method.shading.sampling import Technique, specular_lobe
from neilfpp_method.shading.sampling import cosine as cosine_about
from neilfpp_method.structures import PDF_FLOOR, Material

__all__ = ["directional_albedo", "initial_albedo"]

SIZE = 32
"""Entries of the table along each axis: roughness, and cosine of the viewer."""
DIRECTIONS = 512
"""Number of incident directions from which an entry is computed."""


def directional_albedo(
    material: Material, n: Float[Tensor, "N 3"], wo: Float[Tensor, "N 3"], lobe: Lobe
) -> Float[Tensor, "N 3"]:
    """∫ f(wo, wi) cos θ dwi of the BRDF of METHOD §1, per channel.

        ρ = (1 − m) b D(r, n·wo) + F0 A(r, n·wo) + B(r, n·wo)

    D, A and B are the integrals of the terms of the BRDF (`brdf_terms`), each from a table with bilinear
    interpolation: the split of Karis 2013 (Real Shading in Unreal Engine 4). `n` and `wo` are unit vectors
    without gradient; the gradient flows to the material.
    """
    table = _lobe_integrals(lobe, n.device, n.dtype)
    cosine = (n * wo).sum(-1, keepdim=True).detach()
    # Coordinates of `grid_sample` are in [−1, 1], the last axis first.
    place = torch.cat((cosine, material.roughness.to(n.dtype)), -1) * 2 - 1
    sampled = functional.grid_sample(table, place[None, :, None], padding_mode="border", align_corners=False)
    diffuse, facing, grazing = sampled[0, :, :, 0].unsqueeze(-1)
    return diffuse_reflectance(material) * diffuse + normal_reflectance(material) * facing + grazing


def initial_albedo(base_color: float, metallic: float, lobe: Lobe | None) -> float:
    """Directional albedo along the normal, for roughness 0.5 and grey; Lambertian if `lobe` is None."""
    if lobe is None:
        return base_color
    material = Material(torch.full((1, 3), base_color), torch.full((1, 1), 0.5), torch.full((1, 1), metallic))
    up = torch.tensor([[0.0, 0.0, 1.0]])
    return directional_albedo(material, up, up, lobe).mean().item()


@lru_cache
@torch.no_grad()
def _lobe_integrals(lobe: Lobe, device: torch.device, dtype: torch.dtype) -> Float[Tensor, "1 3 R C"]:
    """D, A and B at the centres of the cells of roughness and viewer cosine; cached per device and dtype."""
    middle = (torch.arange(SIZE) + 0.5) / SIZE
    roughness, cosine = torch.cartesian_prod(middle, middle)[:, :, None].unbind(1)
    up = torch.tensor([0.0, 0.0, 1.0]).expand(len(cosine), 3)
    wo = torch.cat(((1 - cosine.square()).sqrt(), torch.zeros_like(cosine), cosine), -1)

    def integral(technique: Technique, part: Callable[[BrdfTerms], Tensor]) -> Float[Tensor, "R C"]:
        wi = technique.draw(DIRECTIONS, False)
        weight = dot(wi, up).clamp_min(0) / technique.pdf(wi).clamp_min(PDF_FLOOR)
        return (part(brdf_terms(cosines(up, wo, wi), roughness, lobe)) * weight).mean(1).view(SIZE, SIZE)

    table = torch.stack(
        [
            integral(cosine_about(up), lambda terms: terms.diffuse) / math.pi,
            integral(specular_lobe(up, wo, roughness, lobe), lambda terms: terms.facing),
            integral(specular_lobe(up, wo, roughness, lobe), lambda terms: terms.grazing),
        ]
    )
    return table[None].to(device, dtype)
