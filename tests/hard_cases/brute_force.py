"""A path tracer in float64 NumPy, apart from the package: an independent reference for the package's own.

It has none of the techniques that make path tracing fast: every direction is drawn by the cosine, light is
found only by paths that leave the scene, and no path ends early.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from tests import oracles

Array = np.ndarray


@dataclass(frozen=True)
class Estimate:
    """Means (N, 3) and their squared standard errors (N, 3)."""

    mean: Array
    variance: Array


@dataclass(frozen=True)
class Squares:
    """Flat parallelograms of one material each; only the sides that `edge × edge` points to reflect.

    Attributes:
        corner, first, second: corners and edges, (F, 3).
        base_color: (F, 3); roughness, metallic: (F, 1).
        lobe: name of the specular lobe in `oracles`.
    """

    corner: Array
    first: Array
    second: Array
    base_color: Array
    roughness: Array
    metallic: Array
    lobe: str

    @property
    def normal(self) -> Array:
        across = np.cross(self.first, self.second)
        return across / np.linalg.norm(across, axis=-1, keepdims=True)

    def meet(self, origin: Array, direction: Array) -> tuple[Array, Array]:
        """The first square (N,) on rays (N, 3), −1 if there is none, and the distance (N,)."""
        normal = self.normal
        with np.errstate(divide="ignore", invalid="ignore"):
            distance = ((self.corner - origin[:, None]) * normal).sum(-1) / (direction @ normal.T)
            local = origin[:, None] + distance[..., None] * direction[:, None] - self.corner
        inside = distance > 1e-9
        for edge in (self.first, self.second):  # the edges are perpendicular
            along = (local * edge).sum(-1) / (edge**2).sum(-1)
            inside &= (along >= 0) & (along <= 1)
        distance = np.where(inside, distance, np.inf)
        nearest = distance.argmin(1)
        found = distance[np.arange(len(origin)), nearest]
        return np.where(np.isfinite(found), nearest, -1), found


def trace(
    squares: Squares,
    light: Callable[[Array], Array],
    origins: Array,
    directions: Array,
    samples: int,
    bounces: int,
    seed: int,
) -> Estimate:
    """Radiance along camera rays (N, 3) that all hit the scene, from so many paths of each.

    Args:
        light: distant radiance (K, 3) from unit directions (K, 3).
        bounces: largest number of surface vertices of a path.
    """
    rng, rays = np.random.default_rng(seed), len(origins)
    position, direction = np.repeat(origins, samples, 0), np.repeat(directions, samples, 0)
    path, throughput = np.arange(rays * samples), np.ones((rays * samples, 3))
    radiance = np.zeros_like(throughput)
    for _ in range(bounces):
        square, distance = squares.meet(position, direction)
        normal = squares.normal[square]
        kept = (square >= 0) & ((normal * direction).sum(-1) < 0)
        square, normal, path, throughput = square[kept], normal[kept], path[kept], throughput[kept]
        wo = -direction[kept]
        position = position[kept] - distance[kept, None] * wo
        u, azimuth = rng.random(len(path)), 2 * np.pi * rng.random(len(path))
        local = oracles.spherical(np.sqrt(1 - u), azimuth)
        tangent = squares.first[square] / np.linalg.norm(squares.first[square], axis=-1, keepdims=True)
        frame = np.stack((tangent, np.cross(normal, tangent), normal), 1)
        direction = (local[:, None] @ frame)[:, 0]
        material = (squares.base_color[square], squares.roughness[square], squares.metallic[square])
        diffuse, specular = oracles.brdf(squares.lobe, *material, normal, wo, direction)
        throughput = throughput * np.pi * (diffuse + specular)
        free = squares.meet(position, direction)[0] < 0
        radiance[path[free]] += throughput[free] * light(direction[free])
    radiance = radiance.reshape(rays, samples, 3)
    return Estimate(radiance.mean(1), radiance.var(1, ddof=1) / samples)
