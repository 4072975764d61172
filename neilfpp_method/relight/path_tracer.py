"""Light along paths from the camera to the lights (Kajiya 1986), all paths of a block side by side.

At every vertex the light is asked in two ways, and both are weighed by the power heuristic (Veach 1997,
§9.2): a direction drawn by the light (the map, and one lamp), and the direction in which the path goes on,
where it meets a light. Paths of little throughput end by chance (Russian roulette), and those that live on
make up for them: nothing is cut off but what lies beyond `bounces`.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import torch
from jaxtyping import Float, Int
from torch import Tensor

from neilfpp_method.relight.lamplight import Lamplight
from neilfpp_method.relight.scattering import Vertices, scatter, scattered, scattering_pdf, vertices
from neilfpp_method.relight.sequence import Numbers
from neilfpp_method.relight.sky import Sky
from neilfpp_method.relight.surface import OFFSET, Crossings, Surface
from neilfpp_method.shading.brdf import Lobe, diffuse_reflectance, normal_reflectance
from neilfpp_method.structures import Material, RayBatch

__all__ = ["DIMENSIONS", "Scene", "Traced", "power_heuristic", "trace_paths"]

DIMENSIONS = 9
"""Numbers per vertex: three for the next direction, two for the map, three for a lamp, one roulette."""
ROULETTE_FROM = 3
"""Vertices of a path before it may end by chance: the first ones carry most of the light."""
MAX_SURVIVAL = 0.95
"""The largest probability of going on: a path between white walls ends, too."""


@dataclass(frozen=True)
class Scene:
    """All that light meets.

    Attributes:
        surface: where paths bounce, scene frame.
        materials: of points on it.
        lobe: of the BRDF; none: a Lambertian surface.
        sky: light from far away.
        lamps: light from close by. Cameras see neither lamps nor sky.
    """

    surface: Surface
    materials: Callable[[Float[Tensor, "N 3"]], Material]
    lobe: Lobe | None
    sky: Sky
    lamps: Lamplight | None = None


@dataclass(frozen=True)
class Traced:
    """What N camera rays see: radiance from the surface (0 where they meet nothing), 1 or 0 for meeting it,
    and what a denoiser is helped by: reflectance and normal of the surface that is met first."""

    radiance: Float[Tensor, "N 3"]
    alpha: Float[Tensor, " N"]
    albedo: Float[Tensor, "N 3"]
    normal: Float[Tensor, "N 3"]


def power_heuristic(own: Float[Tensor, " N"], other: Float[Tensor, " N"]) -> Float[Tensor, " N"]:
    """Weight of a direction drawn by one of two techniques, own² / (own² + other²); 0 where `own` is."""
    # By the quotient: the squared density of a smooth lobe exceeds float32's precision, not its range.
    ratio = other / torch.where(own > 0, own, 1.0)
    return torch.where(own > 0, 1 / (1 + ratio.square()), 0.0)


@torch.no_grad()
def trace_paths(
    scene: Scene, rays: RayBatch, numbers: Numbers, bounces: int, first_dimension: int = 0
) -> Traced:
    """The light that arrives along camera rays; its mean over samples is unbiased up to `bounces`.

    Args:
        scene: what there is.
        rays: unit directions; row k is path k of `numbers`.
        numbers: dimensions from `first_dimension` on are used, `DIMENSIONS` for each bounce.
        bounces: vertices on the surface, at most; 1 is direct light alone.
    """
    radiance, albedo, normal = (torch.zeros_like(rays.origins) for _ in range(3))
    alpha = torch.zeros_like(rays.origins[:, 0])
    throughput = torch.ones_like(rays.origins)
    paths = torch.arange(len(rays), device=alpha.device)
    met, directions = scene.surface.cross(rays.origins, rays.directions), rays.directions
    alpha[met.rows] = 1.0
    for bounce in range(bounces):
        seen = torch.nonzero(met.outside)[:, 0]
        met = met[seen]
        paths, throughput, directions = paths[met.rows], throughput[met.rows], directions[met.rows]
        if not len(paths):
            break
        at = _vertices(scene, met, -directions)
        if bounce == 0:
            normal[paths] = at.normal
            albedo[paths] = _reflectance(at, scene.lobe)
        u = numbers.at(paths, first_dimension + bounce * DIMENSIONS, DIMENSIONS)

        radiance[paths] += throughput * _from_sky(scene, at, u[:, 3:5])
        if scene.lamps is not None:
            radiance[paths] += throughput * _from_lamps(scene, scene.lamps, at, u[:, 5:8])

        directions = scatter(at, u[:, :3], scene.lobe)
        pdf = scattering_pdf(at, directions, scene.lobe)
        factor = scattered(at, directions, scene.lobe) / pdf.clamp_min(torch.finfo(pdf.dtype).tiny)[:, None]
        throughput = throughput * factor
        alive = torch.nonzero(throughput.amax(-1) > 0)[:, 0]
        paths, throughput, directions, pdf, u = (t[alive] for t in (paths, throughput, directions, pdf, u))
        at = at[alive]
        origins = at.position + OFFSET * at.flat
        met = scene.surface.cross(origins, directions)
        radiance[paths] += throughput * _met_light(scene, at, origins, directions, pdf, met)

        if bounce + 1 >= ROULETTE_FROM:
            life = throughput.amax(-1).clamp_max(MAX_SURVIVAL)
            throughput = throughput / life[:, None]
            met = met[torch.nonzero((u[:, 8] < life)[met.rows])[:, 0]]
    return Traced(radiance, alpha, albedo, normal)


def _vertices(scene: Scene, met: Crossings, wo: Float[Tensor, "N 3"]) -> Vertices:
    return vertices(met.position, met.normal, met.flat, wo, scene.materials(met.position), scene.lobe)


def _reflectance(at: Vertices, lobe: Lobe | None) -> Float[Tensor, "N 3"]:
    diffuse = diffuse_reflectance(at.material, specular=lobe is not None)
    return (diffuse if lobe is None else diffuse + normal_reflectance(at.material)).clamp(0, 1)


# ------------------------------------------------------------------------------------ directions by the light


def _from_sky(scene: Scene, at: Vertices, u: Float[Tensor, "N 2"]) -> Float[Tensor, "N 3"]:
    """Light of the map along a direction that the map has drawn."""
    drawn = scene.sky.sample(u)
    value, rows = _scattering(scene, at, drawn.wi)
    wi, pdf, at = drawn.wi[rows], drawn.pdf[rows], at[rows]
    clear = ~scene.surface.blocked(at.position + OFFSET * at.flat, wi)
    weight = power_heuristic(pdf, scattering_pdf(at, wi, scene.lobe)) * clear / pdf
    light = value * scene.sky.look(wi) * weight[:, None]
    return torch.zeros_like(drawn.wi).index_put((rows,), light)


def _from_lamps(
    scene: Scene, lamps: Lamplight, at: Vertices, u: Float[Tensor, "N 3"]
) -> Float[Tensor, "N 3"]:
    """Light of a lamp along a direction towards it."""
    origins = at.position + OFFSET * at.flat
    drawn = lamps.sample(origins, u)
    value, rows = _scattering(scene, at, drawn.wi)
    rows_kept = drawn.pdf[rows] > 0
    rows, value = rows[rows_kept], value[rows_kept]
    wi, pdf, at = drawn.wi[rows], drawn.pdf[rows], at[rows]
    clear = ~scene.surface.blocked(origins[rows], wi, drawn.distance[rows])
    weight = power_heuristic(pdf, scattering_pdf(at, wi, scene.lobe)) * clear / pdf
    light = value * drawn.radiance[rows] * weight[:, None]
    return torch.zeros_like(drawn.wi).index_put((rows,), light)


def _scattering(
    scene: Scene, at: Vertices, wi: Float[Tensor, "N 3"]
) -> tuple[Float[Tensor, "K 3"], Int[Tensor, " K"]]:
    """f · cosine where it is not zero, and at which rows that is: only there a ray is worth its cost."""
    value = scattered(at, wi, scene.lobe)
    rows = torch.nonzero(value.amax(-1) > 0)[:, 0]
    return value[rows], rows


# ---------------------------------------------------------------------------------- directions by the surface


def _met_light(
    scene: Scene,
    at: Vertices,
    origins: Float[Tensor, "N 3"],
    wi: Float[Tensor, "N 3"],
    pdf: Float[Tensor, " N"],
    met: Crossings,
) -> Float[Tensor, "N 3"]:
    """Light that the directions in which paths go on meet by themselves."""
    nearest = torch.full_like(pdf, torch.inf).index_put((met.rows,), met.distance)
    free = nearest.isinf()
    light = scene.sky.look(wi) * (free * power_heuristic(pdf, scene.sky.pdf(wi)))[:, None]
    lamps = scene.lamps
    for lamp in range(0 if lamps is None else len(lamps.position)):
        distance, radiance = lamps.meet(origins, wi, lamp)
        rows = torch.nonzero(distance < nearest)[:, 0]
        weight = power_heuristic(pdf[rows], lamps.pdf(origins[rows], lamp))
        light = light.index_add(0, rows, radiance[rows] * weight[:, None])
    return light
