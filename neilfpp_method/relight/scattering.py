"""Where paths go on at a surface: the package's BRDF (METHOD §1), and directions in proportion to it.

A direction comes from the specular lobe with the probability `share`, else in proportion to the cosine; its
density is that of the mixture, so every direction of the BRDF can be drawn and weights stay bounded.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import torch
from jaxtyping import Float
from torch import Tensor

from neilfpp_method.shading.brdf import GGX, Lobe, diffuse_reflectance, evaluate, normal_reflectance
from neilfpp_method.shading.frame import local_frame
from neilfpp_method.shading.sampling import pdf_cosine, pdf_specular_lobe
from neilfpp_method.structures import Indexable, Material

__all__ = ["Vertices", "scatter", "scattered", "scattering_pdf", "vertices"]

MIN_SHARE = 0.1
"""Of either technique: an error in the lobe's share costs at most ten times the variance."""


@dataclass(frozen=True)
class Vertices(Indexable):
    """Points of paths: unit `normal` and `wo` away from the surface, the triangle's own normal `flat`, what
    the surface is made of there, and the probability that the next direction comes from the specular lobe."""

    position: Float[Tensor, "N 3"]
    normal: Float[Tensor, "N 3"]
    flat: Float[Tensor, "N 3"]
    wo: Float[Tensor, "N 3"]
    base_color: Float[Tensor, "N 3"]
    roughness: Float[Tensor, "N 1"]
    metallic: Float[Tensor, "N 1"]
    share: Float[Tensor, " N"]

    @property
    def material(self) -> Material:
        return Material(self.base_color, self.roughness, self.metallic)


def vertices(
    position: Float[Tensor, "N 3"],
    normal: Float[Tensor, "N 3"],
    flat: Float[Tensor, "N 3"],
    wo: Float[Tensor, "N 3"],
    material: Material,
    lobe: Lobe | None,
) -> Vertices:
    """Points of paths; `share`: what the lobe sends of constant light over what both parts send, about."""
    if lobe is None:
        share = torch.zeros_like(position[:, 0])
    else:
        cosine = (normal * wo).sum(-1, keepdim=True).clamp(0, 1)
        reflectance = normal_reflectance(material)
        specular = (reflectance + (1 - reflectance) * (1 - cosine).pow(5)).mean(-1)
        diffuse = diffuse_reflectance(material).mean(-1)
        share = (specular / (specular + diffuse).clamp_min(1e-6)).clamp(MIN_SHARE, 1 - MIN_SHARE)
    return Vertices(
        position, normal, flat, wo, material.base_color, material.roughness, material.metallic, share
    )


def scatter(at: Vertices, u: Float[Tensor, "N 3"], lobe: Lobe | None) -> Float[Tensor, "N 3"]:
    """Unit directions for numbers in [0, 1); some lie below the horizon, where nothing is scattered to."""
    from_lobe = u[:, 2] < at.share
    height, turn = (1 - u[:, 0]).sqrt(), u[:, 1]
    if lobe is not None:
        height = torch.where(from_lobe, lobe.sample_cos_h(u[:, :1], at.roughness)[:, 0], height)
    sine = ((1 - height) * (1 + height)).clamp_min(0).sqrt()
    azimuth = 2 * math.pi * turn
    local = torch.stack((sine * azimuth.cos(), sine * azimuth.sin(), height), -1)
    drawn = (local[:, :, None] * local_frame(at.normal)).sum(1)
    mirrored = 2 * (drawn * at.wo).sum(-1, keepdim=True) * drawn - at.wo
    return torch.where(from_lobe[:, None], mirrored, drawn)


def scattering_pdf(at: Vertices, wi: Float[Tensor, "N 3"], lobe: Lobe | None) -> Float[Tensor, " N"]:
    """Density of `scatter`, per steradian."""
    pdf = (1 - at.share) * pdf_cosine(wi[:, None], at.normal)[:, 0]
    if lobe is None:
        return pdf
    return pdf + at.share * pdf_specular_lobe(wi[:, None], at.normal, at.wo, at.roughness, lobe)[:, 0]


def scattered(at: Vertices, wi: Float[Tensor, "N 3"], lobe: Lobe | None) -> Float[Tensor, "N 3"]:
    """f(wo, wi) times the cosine of wi; zero below the horizon, that of the triangle included."""
    # A Lambertian surface asks for no lobe, and `evaluate` looks at none.
    value = evaluate(at.material, at.normal, at.wo, wi[:, None], lobe or GGX, specular=lobe is not None)
    cosine = (wi * at.normal).sum(-1, keepdim=True).clamp_min(0)
    above = (wi * at.flat).sum(-1, keepdim=True) > 0
    return (value.diffuse + value.specular)[:, 0] * cosine * above
