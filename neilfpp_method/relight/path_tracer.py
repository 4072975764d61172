"""Path tracing from the camera (Kajiya 1986), vectorised over a batch of paths.

At every vertex, direct light is estimated with two techniques, which are combined by the power heuristic
(Veach 1997, §9.2): light sampling (one direction of the map, and one of a lamp), and BRDF sampling (the
direction in which the path continues, if it hits a light). Paths of low throughput are terminated by Russian
roulette, which keeps the estimate unbiased up to `bounces`.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import torch
from jaxtyping import Float, Int
from torch import Tensor

from neilfpp_method.relight.lamplight import Lamplight
from neilfpp_method.relight.scattering import Vertices, brdf_cosine, scatter, scattering_pdf, vertices
from neilfpp_method.relight.sequence import Numbers
from neilfpp_method.relight.sky import Sky
from neilfpp_method.relight.surface import OFFSET, Intersections, Surface
from neilfpp_method.shading.brdf import Lobe, diffuse_reflectance, normal_reflectance
from neilfpp_method.structures import Material, RayBatch

__all__ = ["DIMENSIONS", "Scene", "Traced", "power_heuristic", "trace_paths"]

DIMENSIONS = 9
"""Random numbers per vertex: three for the next direction, two for the map, three for a lamp, one for
roulette.
"""
ROULETTE_FROM = 3
"""Number of vertices before Russian roulette begins, because the first ones carry most of the light."""
MAX_SURVIVAL = 0.95
"""Largest probability of survival, so that paths between white surfaces are terminated as well."""


@dataclass(frozen=True)
class Scene:
    """The scene of the path tracer. Cameras see neither lamps nor sky.

    Attributes:
        surface: the surface, scene frame.
        materials: the material at points of the surface.
        lobe: specular lobe of the BRDF; None for a Lambertian surface.
        sky: distant light.
        lamps: lamps near the scene, or None.
    """

    surface: Surface
    materials: Callable[[Float[Tensor, "N 3"]], Material]
    lobe: Lobe | None
    sky: Sky
    lamps: Lamplight | None = None


@dataclass(frozen=True)
class Traced:
    """Results for N camera rays.

    Attributes:
        radiance: radiance from the surface; 0 if the ray misses it.
        alpha: 1 if the ray hits the surface, else 0.
        albedo: reflectance at the first hit, for a denoiser.
        normal: normal at the first hit, for a denoiser.
    """

    radiance: Float[Tensor, "N 3"]
    alpha: Float[Tensor, " N"]
    albedo: Float[Tensor, "N 3"]
    normal: Float[Tensor, "N 3"]


def power_heuristic(own: Float[Tensor, " N"], other: Float[Tensor, " N"]) -> Float[Tensor, " N"]:
    """Weight of a sample from one of two techniques, own² / (own² + other²); 0 if `own` is 0.

    Args:
        own: density of the technique that produced the sample.
        other: density of the other technique.
    """
    # Computed from the quotient, because the squared density of a narrow lobe loses precision in float32.
    ratio = other / torch.where(own > 0, own, 1.0)
    return torch.where(own > 0, 1 / (1 + ratio.square()), 0.0)


@torch.no_grad()
def trace_paths(
    scene: Scene, rays: RayBatch, numbers: Numbers, bounces: int, first_dimension: int = 0
) -> Traced:
    """Estimate the radiance along camera rays with one path each.

    The mean over samples is unbiased for paths of up to `bounces` surface vertices.

    Args:
        scene: the scene.
        rays: camera rays with unit directions; row k is path k of `numbers`.
        numbers: random numbers; dimensions from `first_dimension` on are used, `DIMENSIONS` per vertex.
        bounces: largest number of surface vertices of a path; 1 gives direct light only.
        first_dimension: first dimension of `numbers` that may be used.
    """
    radiance, albedo, normal = (torch.zeros_like(rays.origins) for _ in range(3))
    alpha = torch.zeros_like(rays.origins[:, 0])
    throughput = torch.ones_like(rays.origins)
    paths = torch.arange(len(rays), device=alpha.device)
    hits, directions = scene.surface.intersect(rays.origins, rays.directions), rays.directions
    alpha[hits.rows] = 1.0
    for bounce in range(bounces):
        hits = hits[torch.nonzero(hits.outside)[:, 0]]
        paths, throughput, directions = paths[hits.rows], throughput[hits.rows], directions[hits.rows]
        if not len(paths):
            break
        at = vertices(hits, -directions, scene.materials(hits.position), scene.lobe)
        if bounce == 0:
            normal[paths] = at.normal
            albedo[paths] = _reflectance(at, scene.lobe)
        u = numbers.at(paths, first_dimension + bounce * DIMENSIONS, DIMENSIONS)

        radiance[paths] += throughput * _from_sky(scene, at, u[:, 3:5])
        if scene.lamps is not None:
            radiance[paths] += throughput * _from_lamps(scene, scene.lamps, at, u[:, 5:8])

        directions = scatter(at, u[:, :3], scene.lobe)
        pdf = scattering_pdf(at, directions, scene.lobe)
        smallest = torch.finfo(pdf.dtype).tiny
        throughput = throughput * brdf_cosine(at, directions, scene.lobe) / pdf.clamp_min(smallest)[:, None]
        alive = torch.nonzero(throughput.amax(-1) > 0)[:, 0]
        paths, throughput, directions, pdf, u = (t[alive] for t in (paths, throughput, directions, pdf, u))
        at = at[alive]
        origins = at.position + OFFSET * at.flat
        hits = scene.surface.intersect(origins, directions)
        radiance[paths] += throughput * _from_hit_lights(scene, origins, directions, pdf, hits)

        if bounce + 1 >= ROULETTE_FROM:
            survival = throughput.amax(-1).clamp_max(MAX_SURVIVAL)
            throughput = throughput / survival[:, None]
            hits = hits[torch.nonzero((u[:, 8] < survival)[hits.rows])[:, 0]]
    return Traced(radiance, alpha, albedo, normal)


def _reflectance(at: Vertices, lobe: Lobe | None) -> Float[Tensor, "N 3"]:
    diffuse = diffuse_reflectance(at.material, specular=lobe is not None)
    return (diffuse if lobe is None else diffuse + normal_reflectance(at.material)).clamp(0, 1)


# --------------------------------------------------------------------------------------------- light sampling


def _from_sky(scene: Scene, at: Vertices, u: Float[Tensor, "N 2"]) -> Float[Tensor, "N 3"]:
    """Reflected light of the map, from one direction sampled in proportion to the map."""
    sample = scene.sky.sample(u)
    scattering = _scattering(scene, at, sample.wi)
    rows = scattering.rows
    wi, pdf, at = sample.wi[rows], sample.pdf[rows], at[rows]
    unoccluded = ~scene.surface.blocked(at.position + OFFSET * at.flat, wi)
    weight = power_heuristic(pdf, scattering_pdf(at, wi, scene.lobe)) * unoccluded / pdf
    light = scattering.value * scene.sky.lookup(wi) * weight[:, None]
    return torch.zeros_like(sample.wi).index_put((rows,), light)


def _from_lamps(
    scene: Scene, lamps: Lamplight, at: Vertices, u: Float[Tensor, "N 3"]
) -> Float[Tensor, "N 3"]:
    """Reflected light of the lamps, from one direction towards one of them."""
    origins = at.position + OFFSET * at.flat
    sample = lamps.sample(origins, u)
    scattering = _scattering(scene, at, sample.wi)
    valid = sample.pdf[scattering.rows] > 0
    rows, value = scattering.rows[valid], scattering.value[valid]
    wi, pdf, at = sample.wi[rows], sample.pdf[rows], at[rows]
    unoccluded = ~scene.surface.blocked(origins[rows], wi, sample.distance[rows])
    weight = power_heuristic(pdf, scattering_pdf(at, wi, scene.lobe)) * unoccluded / pdf
    light = value * sample.radiance[rows] * weight[:, None]
    return torch.zeros_like(sample.wi).index_put((rows,), light)


@dataclass(frozen=True)
class _Scattering:
    """The vertices that scatter light from sampled directions, and f · cosine there; the others need no
    shadow ray.
    """

    rows: Int[Tensor, " K"]
    value: Float[Tensor, "K 3"]


def _scattering(scene: Scene, at: Vertices, wi: Float[Tensor, "N 3"]) -> _Scattering:
    value = brdf_cosine(at, wi, scene.lobe)
    rows = torch.nonzero(value.amax(-1) > 0)[:, 0]
    return _Scattering(rows, value[rows])


# ---------------------------------------------------------------------------------------------- BRDF sampling


def _from_hit_lights(
    scene: Scene,
    origins: Float[Tensor, "N 3"],
    wi: Float[Tensor, "N 3"],
    pdf: Float[Tensor, " N"],
    hits: Intersections,
) -> Float[Tensor, "N 3"]:
    """Weighted radiance of the map and the lamps that the next segments of the paths hit."""
    nearest = torch.full_like(pdf, torch.inf).index_put((hits.rows,), hits.distance)
    unoccluded = nearest.isinf()
    light = scene.sky.lookup(wi) * (unoccluded * power_heuristic(pdf, scene.sky.pdf(wi)))[:, None]
    lamps = scene.lamps
    for lamp in range(0 if lamps is None else len(lamps.position)):
        met = lamps.intersect(origins, wi, lamp)
        rows = torch.nonzero(met.distance < nearest)[:, 0]
        weight = power_heuristic(pdf[rows], lamps.pdf(origins[rows], lamp))
        light = light.index_add(0, rows, met.radiance[rows] * weight[:, None])
    return light
