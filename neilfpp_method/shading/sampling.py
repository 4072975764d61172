"""Samplers of incident directions, with their densities.

Every sampler integrates the same integral: the mean over S of f(wi)/pdf(wi) estimates ∫ f dwi over the
hemisphere about n. A `Technique` maps a lattice of the unit square to directions; techniques differ in the
density, and `combine` combines several by the balance heuristic. With `stochastic` each point's lattice is
rotated at random and each sample is uniform in its stratum, so that the estimate is unbiased. Without it the
samples are at the midpoints of the strata, the same at every call.

Directions and densities have no gradient. The estimator's gradient is then the mean of (∂f)/pdf, which
estimates ∂∫f without bias: f·cos is zero at the horizon, so the moving boundary of the hemisphere contributes
nothing.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import torch
from jaxtyping import Float
from torch import Tensor

from neilfpp_method.errors import UserError
from neilfpp_method.shading.brdf import Lobe, cosines
from neilfpp_method.shading.frame import at_least_float32, dot, local_frame
from neilfpp_method.stratified.intervals import strata
from neilfpp_method.structures import IncidentSamples

__all__ = [
    "Sampling",
    "Technique",
    "combine",
    "cosine",
    "fibonacci",
    "pdf_cosine",
    "pdf_fibonacci",
    "pdf_specular_lobe",
    "sample_directions",
    "specular_lobe",
    "sphere_lattice",
]

GOLDEN_TURN = (3 - math.sqrt(5)) / 2
"""The golden angle as a share of a full turn."""

LOBE_SHARE = 0.25
"""Share of the directions of "mis" for the lobe if the light can be sampled, which has the rest
(docs/performance.md).
"""

WITHOUT_LOBE = {"mis": "no_lobe", "lobe": "cosine"}
"""Samplers that replace those of the lobe on Lambertian surfaces, which have none."""


@dataclass(frozen=True)
class Technique:
    """A way to sample directions at N points.

    Attributes:
        draw: `draw(count, stochastic)` returns (N, count, 3) unit directions.
        pdf: returns the density (N, S) of any directions (N, S, 3), per steradian.
    """

    draw: Callable[[int, bool], Float[Tensor, "N S 3"]]
    pdf: Callable[[Float[Tensor, "N S 3"]], Float[Tensor, "N S"]]


@dataclass(frozen=True)
class _Lattice:
    """A Fibonacci lattice of [0, 1)²: one `u` in each of S strata, `v` advances by the golden angle."""

    u: Float[Tensor, "N S"]
    v: Float[Tensor, "N S"]


def _lattice(n: Float[Tensor, "N 3"], count: int, stochastic: bool) -> _Lattice:
    k = torch.arange(count, device=n.device, dtype=n.dtype).expand(len(n), count)
    shift = torch.rand_like(n[:, :1]) if stochastic else 0.0
    return _Lattice(strata(n, count, stochastic), (k * GOLDEN_TURN + shift).frac())


def _about(
    n: Float[Tensor, "N 3"], height: Float[Tensor, "N S"], turn: Float[Tensor, "N S"]
) -> Float[Tensor, "N S 3"]:
    """Unit vectors w of height n·w, at an azimuth given in turns."""
    sine = ((1 - height) * (1 + height)).clamp_min(0).sqrt()
    azimuth = 2 * math.pi * turn
    tangent, bitangent, normal = local_frame(n).unsqueeze(2).unbind(1)
    x, y, z = (sine * azimuth.cos()).unsqueeze(-1), (sine * azimuth.sin()).unsqueeze(-1), height.unsqueeze(-1)
    return x * tangent + y * bitangent + z * normal


# -------------------------------------------------------------------------------------------------- densities


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
    """p(h)/(4 |wo·h|) on the whole sphere; of ±h, the one in the hemisphere about n is the sampled one."""
    cos = cosines(n, wo, wi)
    return lobe.pdf_h(cos.h.abs(), roughness) / (4 * cos.d)


# ------------------------------------------------------------------------------------------------- techniques


def fibonacci(n: Float[Tensor, "N 3"]) -> Technique:
    """The paper's lattice: equal solid angles, samples at their midpoints, n·wi = 1 − (k + ½)/S."""
    return _hemisphere(n, lambda u: 1 - u, pdf_fibonacci)


def cosine(n: Float[Tensor, "N 3"]) -> Technique:
    """Density proportional to n·wi: no variance for a Lambertian surface under constant light."""
    return _hemisphere(n, lambda u: (1 - u).sqrt(), pdf_cosine)


def _hemisphere(
    n: Float[Tensor, "N 3"], height: Callable[[Tensor], Tensor], pdf: Callable[[Tensor, Tensor], Tensor]
) -> Technique:
    """Directions about n whose cosine is `height` of a uniform number, with a uniform azimuth."""
    n = at_least_float32(n)

    def draw(count: int, stochastic: bool) -> Float[Tensor, "N S 3"]:
        lattice = _lattice(n, count, stochastic)
        return _about(n, height(lattice.u), lattice.v)

    return Technique(draw, lambda wi: pdf(wi, n))


def specular_lobe(
    n: Float[Tensor, "N 3"], wo: Float[Tensor, "N 3"], roughness: Float[Tensor, "N 1"], lobe: Lobe
) -> Technique:
    """Mirror directions of wo about half vectors sampled from the lobe; some are below the horizon."""
    n, wo = at_least_float32(n), at_least_float32(wo)

    def draw(count: int, stochastic: bool) -> Float[Tensor, "N S 3"]:
        lattice = _lattice(n, count, stochastic)
        h = _about(n, lobe.sample_cos_h(lattice.u, roughness), lattice.v)
        return 2 * dot(h, wo).unsqueeze(-1) * h - wo.unsqueeze(1)

    return Technique(draw, lambda wi: pdf_specular_lobe(wi, n, wo, roughness, lobe))


# --------------------------------------------------------------------------------------------------- samplers


@torch.no_grad()
def combine(techniques: Sequence[tuple[Technique, int]], stochastic: bool) -> IncidentSamples:
    """Sample `count` directions of each technique, combined by the balance heuristic (Veach 1997, §9.2).

    The density is that of the rounded directions: a lobe cancels exactly against the integrand's.
    """
    techniques = [(technique, count) for technique, count in techniques if count]
    wi = torch.cat([technique.draw(count, stochastic) for technique, count in techniques], 1)
    pdf = sum(technique.pdf(wi) * (count / wi.shape[1]) for technique, count in techniques)
    return IncidentSamples(wi, pdf)


def sphere_lattice(count: int, like: Tensor) -> Float[Tensor, "S 3"]:
    """`count` evenly spread directions of the sphere, on the device of `like`, in at least float32."""
    up = at_least_float32(like).new_tensor([[0.0, 0.0, 1.0]])
    lattice = _lattice(up, count, stochastic=False)
    return _about(up, 1 - 2 * lattice.u, lattice.v)[0]


@dataclass(frozen=True)
class Sampling:
    """How incident directions are sampled.

    Attributes:
        kind: the sampler. "fibonacci", "cosine" and "lobe" are one technique; "mis" is half cosine and half
            lobe, or the light and the lobe if the light can be sampled; "no_lobe" is the light or the cosine.
        count: directions per point.
        lobe: the specular lobe; None for Lambertian surfaces, for which "mis" is "no_lobe" and "lobe" is
            "cosine".
        stochastic: whether the directions are random; if False, every call returns the same ones.
    """

    kind: str
    count: int
    lobe: Lobe | None
    stochastic: bool


def sample_directions(
    sampling: Sampling,
    n: Float[Tensor, "N 3"],
    wo: Float[Tensor, "N 3"],
    roughness: Float[Tensor, "N 1"],
    light: Technique | None = None,
) -> IncidentSamples:
    """Sample incident directions at N points, in at least float32.

    Args:
        sampling: the sampler and the number of directions.
        n, wo: unit normals, and unit directions to the viewer.
        roughness: roughness of the surface.
        light: samples the light times the cosine; None if the light cannot be sampled.

    Raises:
        UserError: there is no such sampler.
    """
    kind, count, lobe = sampling.kind, sampling.count, sampling.lobe
    if lobe is None:
        kind = WITHOUT_LOBE.get(kind, kind)
    if kind == "fibonacci":
        techniques = [(fibonacci(n), count)]
    elif kind == "cosine":
        techniques = [(cosine(n), count)]
    elif kind == "lobe":
        techniques = [(specular_lobe(n, wo, roughness, lobe), count)]
    elif kind == "mis":
        to_lobe = count // 2 if light is None else int(LOBE_SHARE * count)
        techniques = [(light or cosine(n), count - to_lobe), (specular_lobe(n, wo, roughness, lobe), to_lobe)]
    elif kind == "no_lobe":
        techniques = [(light or cosine(n), count)]
    else:
        raise UserError(f"unknown sampler '{kind}'", "choose fibonacci, cosine, lobe, mis or no_lobe")
    return combine(techniques, sampling.stochastic)
