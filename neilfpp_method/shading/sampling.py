"""Samplers of incident directions, with their densities.

Every sampler integrates the same integral: the mean over S of f(wi)/pdf(wi) estimates ∫ f dwi over the
hemisphere about n. A `Technique` maps a `Lattice` of the unit cube to directions; techniques differ in the
density; `combine` and `mix` combine them by the balance heuristic. With `stochastic` each point's lattice is
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
from neilfpp_method.shading.brdf import Lobe, cosines, diffuse_reflectance, normal_reflectance
from neilfpp_method.shading.frame import at_least_float32, dot, local_frame
from neilfpp_method.structures import IncidentSamples, Material

__all__ = [
    "Lattice",
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

LOBE_SHARES = (0.25, 0.75)
"""Share of the directions of "mis" for the lobe of diffuse surfaces, and of mirrors; the light has the rest.

The noise of colours alone would be least with 1/16 and 15/16. But with few directions in the lobe of paint
the derivative in roughness is noisy, and with few to the light that of metal in metallic
(docs/notebook/2026-11-29-noise-of-maps.md).
"""

WITHOUT_LOBE = {"mis": "no_lobe", "lobe": "cosine"}
"""Samplers that replace those of the lobe on Lambertian surfaces, which have none."""


@dataclass(frozen=True)
class Lattice:
    """S points of the unit cube for each of N surface points.

    Attributes:
        u: one in each of S strata.
        v: a Fibonacci lattice together with `u`: it advances by the golden angle.
        w: independent of both; ½ if the lattice is not random.
    """

    u: Float[Tensor, "N S"]
    v: Float[Tensor, "N S"]
    w: Float[Tensor, "N S"]

    @staticmethod
    def of(index: Float[Tensor, "N S"], count: Float[Tensor, "#N #S"] | int, stochastic: bool) -> Lattice:
        """The points of these indices in lattices of `count` points.

        Args:
            index: whole numbers from 0 to below `count`.
            count: size of the lattice to which each point belongs.
            stochastic: whether points are random in their strata, and lattices rotated.
        """
        if stochastic:
            within, w = torch.rand((2, *index.shape), dtype=index.dtype, device=index.device)
            shift = torch.rand_like(index[:, :1])
        else:
            within = w = shift = torch.full_like(index, 0.5)
        return Lattice((index + within) / count, (index * GOLDEN_TURN + shift).frac(), w)


@dataclass(frozen=True)
class Technique:
    """A way to sample directions at N points.

    Attributes:
        normal: unit normals of the points.
        place: maps a lattice to unit directions (N, S, 3).
        pdf: returns the density (N, S) of any directions (N, S, 3), per steradian.
    """

    normal: Float[Tensor, "N 3"]
    place: Callable[[Lattice], Float[Tensor, "N S 3"]]
    pdf: Callable[[Float[Tensor, "N S 3"]], Float[Tensor, "N S"]]

    def draw(self, count: int, stochastic: bool) -> Float[Tensor, "N S 3"]:
        """Draw `count` directions per point."""
        return self.place(Lattice.of(_indices(self.normal, count), count, stochastic))


def _indices(normal: Float[Tensor, "N 3"], count: int) -> Float[Tensor, "N {count}"]:
    return torch.arange(count, device=normal.device, dtype=normal.dtype).expand(len(normal), count)


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
    return Technique(n, lambda at: _about(n, height(at.u), at.v), lambda wi: pdf(wi, n))


def specular_lobe(
    n: Float[Tensor, "N 3"], wo: Float[Tensor, "N 3"], roughness: Float[Tensor, "N 1"], lobe: Lobe
) -> Technique:
    """Mirror directions of wo about half vectors sampled from the lobe; some are below the horizon."""
    n, wo = at_least_float32(n), at_least_float32(wo)

    def place(at: Lattice) -> Float[Tensor, "N S 3"]:
        h = _about(n, lobe.sample_cos_h(at.u, roughness), at.v)
        return 2 * dot(h, wo).unsqueeze(-1) * h - wo.unsqueeze(1)

    return Technique(n, place, lambda wi: pdf_specular_lobe(wi, n, wo, roughness, lobe))


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


@torch.no_grad()
def mix(
    first: Technique,
    second: Technique,
    of_second: Float[Tensor, "N 1"],
    count: int,
    stochastic: bool,
) -> IncidentSamples:
    """Sample `count` directions, of which each point has its own share from the second technique.

    The two are combined by the balance heuristic. Each has at least one direction, if there are two.

    Args:
        first, second: the techniques.
        of_second: share of the directions that the second technique draws, 0 to 1.
        count: directions per point.
        stochastic: whether the directions are random.
    """
    index = _indices(first.normal, count)
    by_second = (of_second.to(index) * count).round().clamp(min(1, count - 1), count - 1)
    is_second = index < by_second
    lattice = Lattice.of(
        torch.where(is_second, index, index - by_second),
        torch.where(is_second, by_second, count - by_second),
        stochastic,
    )
    wi = torch.where(is_second.unsqueeze(-1), second.place(lattice), first.place(lattice))
    weight = by_second / count
    return IncidentSamples(wi, first.pdf(wi) * (1 - weight) + second.pdf(wi) * weight)


def sphere_lattice(count: int, like: Tensor) -> Float[Tensor, "S 3"]:
    """`count` evenly spread directions of the sphere, on the device of `like`, in at least float32."""
    up = at_least_float32(like).new_tensor([[0.0, 0.0, 1.0]])
    lattice = Lattice.of(_indices(up, count), count, stochastic=False)
    return _about(up, 1 - 2 * lattice.u, lattice.v)[0]


@dataclass(frozen=True)
class Sampling:
    """How incident directions are sampled.

    Attributes:
        kind: the sampler. "fibonacci", "cosine" and "lobe" are one technique; "mis" is half cosine and half
            lobe, or, if the light can be sampled, the light and the lobe in shares by material
            (`lobe_share`); "no_lobe" is the light or the cosine.
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
    material: Material,
    light: Technique | None = None,
) -> IncidentSamples:
    """Sample incident directions at N points, in at least float32.

    Args:
        sampling: the sampler and the number of directions.
        n, wo: unit normals, and unit directions to the viewer.
        material: material of the surface.
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
        techniques = [(specular_lobe(n, wo, material.roughness, lobe), count)]
    elif kind == "mis" and light is None:
        by_lobe = specular_lobe(n, wo, material.roughness, lobe)
        techniques = [(cosine(n), count - count // 2), (by_lobe, count // 2)]
    elif kind == "mis":
        by_lobe = specular_lobe(n, wo, material.roughness, lobe)
        return mix(light, by_lobe, lobe_share(material), count, sampling.stochastic)
    elif kind == "no_lobe":
        techniques = [(light or cosine(n), count)]
    else:
        raise UserError(f"unknown sampler '{kind}'", "choose fibonacci, cosine, lobe, mis or no_lobe")
    return combine(techniques, sampling.stochastic)


def lobe_share(material: Material) -> Float[Tensor, "N 1"]:
    """Share of the directions for the lobe beside directions to the light, within `LOBE_SHARES`.

    It grows with the specular share of the reflectance at normal incidence, and is smaller for rough
    surfaces, of which the light's directions sample the whole reflection well.
    """
    specular, diffuse = (
        part(material).mean(-1, keepdim=True) for part in (normal_reflectance, diffuse_reflectance)
    )
    least, most = LOBE_SHARES
    glossy = specular / (specular + diffuse).clamp_min(1e-6) * (1 - material.roughness.square())
    return least + (most - least) * glossy
