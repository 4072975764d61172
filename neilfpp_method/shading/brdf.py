"""The simplified Disney BRDF, f = f_d + f_s (METHOD §1), with two microfacet lobes and two diffuse ones.

    f_d = (1 − m)/π · b · d(wo, wi, r),  d = 1 for Lambert's lobe
    f_s = D(n·h) · F(wo·h) · V(n·wi, n·wo),  V = G / (4 (n·wi)(n·wo))

V is always computed in the form in which the cosines have cancelled, without 0/0 at grazing angles. All
results are in at least float32.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace

import torch
from jaxtyping import Float
from torch import Tensor

from neilfpp_method.shading.frame import at_least_float32, dot
from neilfpp_method.structures import Material

__all__ = [
    "DIELECTRIC_F0",
    "GGX",
    "GGX_BURLEY",
    "LOBES",
    "SPHERICAL_GAUSSIAN",
    "BrdfTerms",
    "BrdfValue",
    "Cosines",
    "Lobe",
    "brdf_terms",
    "cosines",
    "diffuse_reflectance",
    "evaluate",
    "normal_reflectance",
    "roughness_floor",
]

DIELECTRIC_F0 = 0.04
"""Reflectance of a dielectric at normal incidence, that of an index of refraction of 1.5."""


# ------------------------------------------------------------------------------------------------------ lobes


@dataclass(frozen=True)
class Lobe:
    """A microfacet lobe and the diffuse lobe beside it, as functions of cosines and roughness (N, 1).

    All values are (N, S). Roughness below `roughness_floor` counts as that floor, without a gradient.
    """

    distribution: Callable[[Tensor, Tensor], Tensor]
    """D(n·h, r), density of microfacet area per steradian."""
    visibility: Callable[[Tensor, Tensor, Tensor], Tensor]
    """V(n·wi, n·wo, r), for cosines ≥ 0."""
    sample_cos_h: Callable[[Tensor, Tensor], Tensor]
    """n·h for uniform numbers in [0, 1), such that h, at a uniform azimuth, has the density `pdf_h`."""
    pdf_h: Callable[[Tensor, Tensor], Tensor]
    """Density of h per steradian of the hemisphere about n, for n·h ≥ 0."""
    diffuse: Callable[[Cosines, Tensor], Tensor] | None = None
    """d, the diffuse lobe relative to Lambert's, from all cosines and r; None: Lambert's own, d = 1."""


def roughness_floor(dtype: torch.dtype) -> float:
    """The smallest roughness that a lobe can resolve: (32 ε)^¼, 0.044 in float32 and 2.9e-4 in float64.

    D varies on the scale 1 − n·h ~ r⁴/2, and n·h, a number near 1, is rounded to ε/2. At the floor that
    rounding moves D by 3 %; below, D would be noise. The floor also bounds the lobe: in float32 D ≤ 8.4e4 and
    V ≤ 1/r⁴ = 2.6e5.
    """
    return (32 * torch.finfo(dtype).eps) ** 0.25


def _alpha(roughness: Float[Tensor, "N 1"]) -> Float[Tensor, "N 1"]:
    """Microfacet width α = r², floored."""
    wide = at_least_float32(roughness)
    return wide.clamp_min(roughness_floor(wide.dtype)).square()


# The paper's lobe. ∫ D (n·h) dh = 1 − (r⁴/2)(1 − e^(−2/r⁴)): it loses energy, 43 % of it at r = 1.


def _sg_distribution(cos_h: Float[Tensor, "N S"], roughness: Float[Tensor, "N 1"]) -> Float[Tensor, "N S"]:
    """D = 1/(π r⁴) · exp(2/r⁴ · (n·h − 1))."""
    alpha_squared = _alpha(roughness).square()
    return torch.exp(2 * (cos_h - 1) / alpha_squared) / (math.pi * alpha_squared)


def _sg_visibility(
    cos_i: Float[Tensor, "N S"], cos_o: Float[Tensor, "N 1"], roughness: Float[Tensor, "N 1"]
) -> Float[Tensor, "N S"]:
    """V = 1/((2 − r²) n·wi + r²) · 1/((2 − r²) n·wo + r²), from G1(z) = 2z/((2 − r²) z + r²)."""
    alpha = _alpha(roughness)
    return 1 / (((2 - alpha) * cos_i + alpha) * ((2 - alpha) * cos_o + alpha))


def _sg_pdf_h(cos_h: Float[Tensor, "N S"], roughness: Float[Tensor, "N 1"]) -> Float[Tensor, "N S"]:
    """D over its integral without the cosine, 1 − e^(−2/r⁴): this density can be inverted in closed form."""
    return _sg_distribution(cos_h, roughness) / -torch.expm1(-2 / _alpha(roughness).square())


def _sg_sample_cos_h(u: Float[Tensor, "N S"], roughness: Float[Tensor, "N 1"]) -> Float[Tensor, "N S"]:
    """n·h = 1 + (r⁴/2) log(1 − u (1 − e^(−2/r⁴)))."""
    half_width = _alpha(roughness).square() / 2
    return (1 + half_width * torch.log1p(u * torch.expm1(-1 / half_width))).clamp_min(0)


# Trowbridge-Reitz (GGX), α = r², with Smith's height-correlated masking and shadowing (Heitz 2014, eq. 99).


def _ggx_distribution(cos_h: Float[Tensor, "N S"], roughness: Float[Tensor, "N 1"]) -> Float[Tensor, "N S"]:
    """D = α² / (π (sin²θ + α² cos²θ)²), θ the angle between n and h."""
    alpha_squared = _alpha(roughness).square()
    # (1 − c)(1 + c) keeps the digits that 1 − c² loses near c = 1.
    spread = (1 - cos_h) * (1 + cos_h) + alpha_squared * cos_h.square()
    return alpha_squared / (math.pi * spread.square())


def _ggx_visibility(
    cos_i: Float[Tensor, "N S"], cos_o: Float[Tensor, "N 1"], roughness: Float[Tensor, "N 1"]
) -> Float[Tensor, "N S"]:
    """V = ½ / (n·wo √(α² + (1 − α²)(n·wi)²) + n·wi √(α² + (1 − α²)(n·wo)²))."""
    alpha_squared = _alpha(roughness).square()

    def masking(cosine: Tensor) -> Tensor:
        return (alpha_squared + (1 - alpha_squared) * cosine.square()).sqrt()

    # V grows as 1/(n·wi + n·wo) at the horizon; the bound acts where both are within 0.03° of it.
    return 0.5 / (cos_o * masking(cos_i) + cos_i * masking(cos_o)).clamp_min(1e-6)


def _ggx_pdf_h(cos_h: Float[Tensor, "N S"], roughness: Float[Tensor, "N 1"]) -> Float[Tensor, "N S"]:
    """D (n·h), whose integral is 1."""
    return _ggx_distribution(cos_h, roughness) * cos_h


def _ggx_sample_cos_h(u: Float[Tensor, "N S"], roughness: Float[Tensor, "N 1"]) -> Float[Tensor, "N S"]:
    """n·h = √((1 − u)/(1 − u + α² u))."""
    return ((1 - u) / (1 - u + _alpha(roughness).square() * u)).sqrt()


def _burley_diffuse(cos: Cosines, roughness: Float[Tensor, "N 1"]) -> Float[Tensor, "N S"]:
    """d of Disney's BRDF (Burley 2012, "Physically-based shading at Disney", §5.3), for cosines ≥ 0.

        d = (1 + f (1 − n·wi)⁵)(1 + f (1 − n·wo)⁵),  f = 2 r (wo·h)² − ½

    At grazing angles a smooth surface is darker than Lambert's, because it reflects more of the light before
    it can scatter, and a rough one is brighter.
    """
    change = 2 * at_least_float32(roughness) * cos.d.square() - 0.5
    towards, away = (1 + change * (1 - cosine.clamp(0, 1)).pow(5) for cosine in (cos.i, cos.o))
    return towards * away


SPHERICAL_GAUSSIAN = Lobe(_sg_distribution, _sg_visibility, _sg_sample_cos_h, _sg_pdf_h)
GGX = Lobe(_ggx_distribution, _ggx_visibility, _ggx_sample_cos_h, _ggx_pdf_h)
GGX_BURLEY = replace(GGX, diffuse=_burley_diffuse)
LOBES: Mapping[str, Lobe] = {
    "spherical_gaussian": SPHERICAL_GAUSSIAN,
    "ggx": GGX,
    "ggx_burley": GGX_BURLEY,
}


# --------------------------------------------------------------------------------------------------- geometry


@dataclass(frozen=True)
class Cosines:
    """`i` = n·wi, `o` = n·wo, `h` = n·h, `d` = wo·h = wi·h ≥ 0; half vector h = (wi + wo)/|wi + wo|."""

    i: Float[Tensor, "N S"]
    o: Float[Tensor, "N 1"]
    h: Float[Tensor, "N S"]
    d: Float[Tensor, "N S"]


def cosines(n: Float[Tensor, "N 3"], wo: Float[Tensor, "N 3"], wi: Float[Tensor, "#N S 3"]) -> Cosines:
    """The cosines that the BRDF is a function of, for unit vectors.

    h is never formed: |wi + wo| = 2 wo·h and (wo·h)² = (1 + wi·wo)/2. For wi = −wo there is no h; the floor
    on (wo·h)² keeps value and gradient finite there.
    """
    i, o = dot(wi, n), dot(wo.unsqueeze(1), n)
    d = ((1 + dot(wi, wo)) / 2).clamp(1e-8, 1).sqrt()
    return Cosines(i, o, ((i + o) / (2 * d)).clamp(-1, 1), d)


# ------------------------------------------------------------------------------------------------------- BRDF


@dataclass(frozen=True)
class BrdfValue:
    """f per steradian, without the cosine, as `diffuse` + `specular`."""

    diffuse: Float[Tensor, "N S 3"]
    specular: Float[Tensor, "N S 3"]


@dataclass(frozen=True)
class BrdfTerms:
    """f = k_d/π · `diffuse` + F0 · `facing` + `grazing`: scalars per direction, without colours."""

    diffuse: Float[Tensor, "N S"]
    facing: Float[Tensor, "N S"]
    grazing: Float[Tensor, "N S"]


def diffuse_reflectance(material: Material, specular: bool = True) -> Float[Tensor, "N 3"]:
    """k_d = (1 − m) b, or b for a surface without a specular part."""
    base_color = at_least_float32(material.base_color)
    return base_color * (1 - material.metallic) if specular else base_color


def normal_reflectance(material: Material) -> Float[Tensor, "N 3"]:
    """F0 = 0.04 (1 − m) + b m."""
    base_color, metallic = at_least_float32(material.base_color), material.metallic
    return DIELECTRIC_F0 * (1 - metallic) + base_color * metallic


def brdf_terms(cos: Cosines, roughness: Float[Tensor, "N 1"], lobe: Lobe) -> BrdfTerms:
    """The scalars of both lobes; those of the specular one are zero for wi at or below the horizon.

    With s = (1 − wo·h)⁵, Schlick's F0 + (1 − F0) s is F0 (1 − s) + s. (The power is on the whole bracket; the
    supplement of the paper misprints it.) A viewer below the horizon, which blended normals can bring about,
    counts as one at the horizon.
    """
    reflected = lobe.distribution(cos.h, roughness) * lobe.visibility(
        cos.i.clamp_min(0), cos.o.clamp_min(0), roughness
    )
    reflected = torch.where(cos.i > 0, reflected, 0.0)
    grazing = reflected * (1 - cos.d).pow(5)
    diffuse = torch.ones_like(cos.i) if lobe.diffuse is None else lobe.diffuse(cos, roughness)
    return BrdfTerms(diffuse, reflected - grazing, grazing)


def evaluate(
    material: Material,
    n: Float[Tensor, "N 3"],
    wo: Float[Tensor, "N 3"],
    wi: Float[Tensor, "#N S 3"],
    lobe: Lobe,
    specular: bool = True,
) -> BrdfValue:
    """f(wo, wi) of METHOD §1; exactly zero for wi at or below the horizon.

    `n`, `wo`, `wi` are unit and point away from the surface. With `specular=False` the surface is Lambertian:
    f = b/π.
    """
    above = (dot(wi, n) > 0).unsqueeze(-1)
    diffuse = (diffuse_reflectance(material, specular) / math.pi).unsqueeze(1) * above
    if not specular:
        return BrdfValue(diffuse, torch.zeros_like(diffuse))
    terms = brdf_terms(cosines(n, wo, wi), material.roughness, lobe)
    facing, grazing = terms.facing.unsqueeze(-1), terms.grazing.unsqueeze(-1)
    diffuse = diffuse * terms.diffuse.unsqueeze(-1)
    return BrdfValue(diffuse, normal_reflectance(material).unsqueeze(1) * facing + grazing)
