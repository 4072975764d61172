"""Incident directions and the densities that drew them.

Every sampler integrates the same integral: the mean over S of f(wi)/pdf(wi) estimates ∫ f dwi over the hemisphere about
n. All map one lattice of the unit square to directions; they differ in the density. With `stochastic` each point's
lattice is turned by a random azimuth and each sample moves uniformly within its stratum, so that the expectation is
exact; without it the lattice lies at the midpoints, the same at every call.

Directions and densities are constants, without gradient. The estimator's gradient is then the mean of (∂f)/pdf, which
estimates ∂∫f without bias: with f·cos zero at the horizon, the moving edge of the hemisphere adds nothing.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import torch
from jaxtyping import Float
from torch import Tensor

from neilfpp_method.errors import UserError
from neilfpp_method.shading.brdf import Lobe, cosines
from neilfpp_method.shading.frame import at_least_float32, dot, local_frame
from neilfpp_method.structures import IncidentSamples

__all__ = [
    "cosine",
    "fibonacci",
    "mis",
    "pdf_cosine",
    "pdf_fibonacci",
    "pdf_mis",
    "pdf_specular_lobe",
    "sample_directions",
    "specular_lobe",
]

GOLDEN_TURN = (3 - math.sqrt(5)) / 2
"""The golden angle as a share of a full turn."""


@dataclass(frozen=True)
class _Lattice:
    """A Fibonacci lattice of [0, 1)²: `u` has one sample in each of S strata, `v` advances by the golden angle."""

    u: Float[Tensor, "N S"]
    v: Float[Tensor, "N S"]


def _lattice(n: Float[Tensor, "N 3"], count: int, stochastic: bool) -> _Lattice:
    k = torch.arange(count, device=n.device, dtype=n.dtype).expand(len(n), count)
    if stochastic:
        return _Lattice((k + torch.rand_like(k)) / count, (k * GOLDEN_TURN + torch.rand_like(n[:, :1])).frac())
    return _Lattice((k + 0.5) / count, (k * GOLDEN_TURN).frac())


def _about(n: Float[Tensor, "N 3"], height: Float[Tensor, "N S"], turn: Float[Tensor, "N S"]) -> Float[Tensor, "N S 3"]:
    """Unit vectors w of height n·w, at an azimuth given in turns."""
    sine = ((1 - height) * (1 + height)).clamp_min(0).sqrt()
    azimuth = 2 * math.pi * turn
    tangent, bitangent, normal = local_frame(n).unsqueeze(2).unbind(1)
    x, y, z = (sine * azimuth.cos()).unsqueeze(-1), (sine * azimuth.sin()).unsqueeze(-1), height.unsqueeze(-1)
    return x * tangent + y * bitangent + z * normal


# ------------------------------------------------------------------------------------------------------------ densities


def pdf_fibonacci(wi: Float[Tensor, "N S 3"], n: Float[Tensor, "N 3"]) -> Float[Tensor, "N S"]:
    """1/(2π) on the hemisphere about n."""
    cos_i = dot(wi, n)
    return (cos_i >= 0).to(cos_i.dtype) / (2 * math.pi)


def pdf_cosine(wi: Float[Tensor, "N S 3"], n: Float[Tensor, "N 3"]) -> Float[Tensor, "N S"]:
    """(n·wi)/π on the hemisphere about n."""
    return dot(wi, n).clamp_min(0) / math.pi


def pdf_specular_lobe(
    wi: Float[Tensor, "N S 3"],
    n: Float[Tensor, "N 3"],
    wo: Float[Tensor, "N 3"],
    roughness: Float[Tensor, "N 1"],
    lobe: Lobe,
) -> Float[Tensor, "N S"]:
    """p(h)/(4 |wo·h|) over the whole sphere; of ±h, that which lies in the hemisphere about n was drawn."""
    cos = cosines(n, wo, wi)
    return lobe.pdf_h(cos.h.abs(), roughness) / (4 * cos.d)


def pdf_mis(
    wi: Float[Tensor, "N S 3"],
    n: Float[Tensor, "N 3"],
    wo: Float[Tensor, "N 3"],
    roughness: Float[Tensor, "N 1"],
    lobe: Lobe,
    cosine_share: float = 0.5,
) -> Float[Tensor, "N S"]:
    """The mixture of `pdf_cosine` and `pdf_specular_lobe`."""
    specular = pdf_specular_lobe(wi, n, wo, roughness, lobe)
    return cosine_share * pdf_cosine(wi, n) + (1 - cosine_share) * specular


# ------------------------------------------------------------------------------------------------------------- samplers


@torch.no_grad()
def fibonacci(n: Float[Tensor, "N 3"], count: int, stochastic: bool) -> IncidentSamples:
    """The paper's lattice, with cells of equal solid angle and samples at their midpoints, n·wi = 1 − (k + ½)/S."""
    n = at_least_float32(n)
    lattice = _lattice(n, count, stochastic)
    wi = _about(n, 1 - lattice.u, lattice.v)
    return IncidentSamples(wi, pdf_fibonacci(wi, n))


@torch.no_grad()
def cosine(n: Float[Tensor, "N 3"], count: int, stochastic: bool) -> IncidentSamples:
    """Directions in proportion to n·wi: no variance on a Lambertian surface under constant light."""
    n = at_least_float32(n)
    lattice = _lattice(n, count, stochastic)
    wi = _about(n, (1 - lattice.u).sqrt(), lattice.v)
    return IncidentSamples(wi, pdf_cosine(wi, n))


@torch.no_grad()
def specular_lobe(
    n: Float[Tensor, "N 3"],
    wo: Float[Tensor, "N 3"],
    roughness: Float[Tensor, "N 1"],
    count: int,
    lobe: Lobe,
    stochastic: bool,
) -> IncidentSamples:
    """Mirror directions of wo about half vectors that the lobe draws; some fall below the horizon."""
    n, wo = at_least_float32(n), at_least_float32(wo)
    lattice = _lattice(n, count, stochastic)
    h = _about(n, lobe.sample_cos_h(lattice.u, roughness), lattice.v)
    wi = 2 * dot(h, wo).unsqueeze(-1) * h - wo.unsqueeze(1)
    # The density is taken at wi as it was rounded: then D cancels exactly against the D of the integrand.
    return IncidentSamples(wi, pdf_specular_lobe(wi, n, wo, roughness, lobe))


@torch.no_grad()
def mis(
    n: Float[Tensor, "N 3"],
    wo: Float[Tensor, "N 3"],
    roughness: Float[Tensor, "N 1"],
    count: int,
    lobe: Lobe,
    stochastic: bool,
) -> IncidentSamples:
    """Half from the cosine, half from the lobe, joined by the balance heuristic (Veach 1997, §9.2)."""
    lobe_count = count // 2
    cosine_count = count - lobe_count
    broad = cosine(n, cosine_count, stochastic)
    sharp = specular_lobe(n, wo, roughness, lobe_count, lobe, stochastic)
    wi = torch.cat((broad.wi, sharp.wi), 1)
    return IncidentSamples(wi, pdf_mis(wi, n, wo, roughness, lobe, cosine_count / count))


def sample_directions(
    kind: str,
    n: Float[Tensor, "N 3"],
    wo: Float[Tensor, "N 3"],
    roughness: Float[Tensor, "N 1"],
    count: int,
    lobe: Lobe,
    stochastic: bool,
) -> IncidentSamples:
    """`count` incident directions per point, in at least float32, by fibonacci, cosine, lobe or mis.

    Raises:
        UserError: there is no such sampler.
    """
    if kind == "fibonacci":
        return fibonacci(n, count, stochastic)
    if kind == "cosine":
        return cosine(n, count, stochastic)
    if kind == "lobe":
        return specular_lobe(n, wo, roughness, count, lobe, stochastic)
    if kind == "mis":
        return mis(n, wo, roughness, count, lobe, stochastic)
    raise UserError(f"unknown sampler '{kind}'", "choose fibonacci, cosine, lobe or mis")
