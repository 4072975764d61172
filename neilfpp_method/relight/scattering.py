"""Scattering at surface vertices: the package's BRDF, and directions sampled in approximate proportion to it.

A direction is sampled from the specular lobe with probability `share`, and otherwise in proportion to the
cosine. Its density is that of the mixture, so every direction of the BRDF can be sampled and weights are
bounded.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import torch
from jaxtyping import Float
from torch import Tensor

from neilfpp_method.relight.surface import Intersections
from neilfpp_method.shading.brdf import GGX, Lobe, diffuse_reflectance, evaluate, normal_reflectance
from neilfpp_method.shading.frame import local_frame
from neilfpp_method.shading.sampling import pdf_cosine, pdf_specular_lobe
from neilfpp_method.structures import Indexable, Material

__all__ = ["Vertices", "brdf_cosine", "scatter", "scattering_pdf", "vertices"]

MIN_SHARE = 0.1
"""Least probability of each technique. It bounds the increase of the variance by a bad estimate of `share` to
a factor of ten.
"""


@dataclass(frozen=True)
class Vertices(Indexable):
    """Surface vertices of N paths.

    Attributes:
        position: positions, scene frame.
        normal: unit shading normals.
        flat: unit normals of the triangles.
        wo: unit directions to the previous vertices.
        base_color: base colour, linear.
        roughness: roughness.
        metallic: metallic.
        share: probability that the next direction is sampled from the specular lobe.
    """

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
    hits: Intersections, wo: Float[Tensor, "N 3"], material: Material, lobe: Lobe | None
) -> Vertices:
    """Build vertices. `share` approximates the lobe's part of the reflectance under constant light."""
    if lobe is None:
        share = torch.zeros_like(hits.distance)
    else:
        cosine = (hits.normal * wo).sum(-1, keepdim=True).clamp(0, 1)
        reflectance = normal_reflectance(material)
        specular = (reflectance + (1 - reflectance) * (1 - cosine).pow(5)).mean(-1)
        diffuse = diffuse_reflectance(material).mean(-1)
        share = (specular / (specular + diffuse).clamp_min(1e-6)).clamp(MIN_SHARE, 1 - MIN_SHARE)
    return Vertices(
        position=hits.position,
        normal=hits.normal,
        flat=hits.flat,
        wo=wo,
        base_color=material.base_color,
        roughness=material.roughness,
        metallic=material.metallic,
        share=share,
    )


def scatter(at: Vertices, u: Float[Tensor, "N 3"], lobe: Lobe | None) -> Float[Tensor, "N 3"]:
    """Sample unit directions from random numbers in [0, 1).

    Directions below the horizon can occur; the BRDF is zero there.
    """
    from_lobe = u[:, 2] < at.share
    cosine = (1 - u[:, 0]).sqrt()
    if lobe is not None:
        cosine = torch.where(from_lobe, lobe.sample_cos_h(u[:, :1], at.roughness)[:, 0], cosine)
    sine = ((1 - cosine) * (1 + cosine)).clamp_min(0).sqrt()
    azimuth = 2 * math.pi * u[:, 1]
    local = torch.stack((sine * azimuth.cos(), sine * azimuth.sin(), cosine), -1)
    # A direction if it is sampled by the cosine, a half vector if it is sampled from the lobe.
    vector = (local[:, :, None] * local_frame(at.normal)).sum(1)
    mirrored = 2 * (vector * at.wo).sum(-1, keepdim=True) * vector - at.wo
    return torch.where(from_lobe[:, None], mirrored, vector)


def scattering_pdf(at: Vertices, wi: Float[Tensor, "N 3"], lobe: Lobe | None) -> Float[Tensor, " N"]:
    """Density of `scatter`, per steradian."""
    pdf = (1 - at.share) * pdf_cosine(wi[:, None], at.normal)[:, 0]
    if lobe is None:
        return pdf
    return pdf + at.share * pdf_specular_lobe(wi[:, None], at.normal, at.wo, at.roughness, lobe)[:, 0]


def brdf_cosine(at: Vertices, wi: Float[Tensor, "N 3"], lobe: Lobe | None) -> Float[Tensor, "N 3"]:
    """f(wo, wi) times the cosine of wi; zero below the horizon of the shading normal or of the triangle."""
    # For a Lambertian surface `evaluate` does not use the lobe.
    value = evaluate(at.material, at.normal, at.wo, wi[:, None], lobe or GGX, specular=lobe is not None)
    cosine = (wi * at.normal).sum(-1, keepdim=True).clamp_min(0)
    above = (wi * at.flat).sum(-1, keepdim=True) > 0
    return (value.diffuse + value.specular)[:, 0] * cosine * above
