"""A ball of known material under a known environment map, rendered by quadrature in float64 NumPy.

The rendering does not use the package, so its images are an independent reference for shading and for the
results of training. The ball is convex, so there is no light between its points.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field

import numpy as np

from tests import oracles

Array = np.ndarray

RADIUS, DISTANCE = 0.8, 3.0
"""Radius of the ball about the origin, and distance of the cameras from the origin, scene units."""
ROWS = 16
"""Rows of the environment maps."""
SPECULAR_DIRECTIONS, TEXEL_PARTS = 512, 3
"""Half vectors per point, and parts of a texel along each axis, in the quadratures."""


def sky(window: float = 20.0, above: float = 1.0, below: float = 0.3) -> Array:
    """A map (16, 32, 3): a bright half, a dim half, and a window of 36° by 23° in it."""
    radiance = np.full((ROWS, 2 * ROWS, 3), below)
    radiance[: ROWS // 2] = above
    radiance[3:6, 10:12] = window
    return radiance * np.array([1.0, 0.9, 0.8])


def sun(radiance: float = 1e5) -> Array:
    """A dim map with a sun of one texel, whose bilinear radiance peaks at `radiance`."""
    dim = np.full((ROWS, 2 * ROWS, 3), 1.0)
    dim[4, 11] = radiance
    return dim


def radiance_from(environment: Array, wi: Array) -> Array:
    """The map (H, W, 3) at unit directions (..., 3), bilinear between texels (docs/conventions.md)."""
    height, width, _ = environment.shape
    row = np.arccos(wi[..., 2].clip(-1, 1)) / np.pi * (height - 1)
    column = np.arctan2(wi[..., 0], wi[..., 1]) / (2 * np.pi) % 1.0 * width - 0.5
    top, left = np.minimum(np.floor(row).astype(int), height - 2), np.floor(column).astype(int)
    down, across = (row - top)[..., None], (column - left)[..., None]
    left, right = left % width, (left + 1) % width
    upper = (1 - across) * environment[top, left] + across * environment[top, right]
    lower = (1 - across) * environment[top + 1, left] + across * environment[top + 1, right]
    return (1 - down) * upper + down * lower


def texel_directions(environment: Array) -> tuple[Array, Array]:
    """Directions (K, 3) spread over the sphere, nine in each texel, and their solid angles (K,)."""
    rows, columns = (TEXEL_PARTS * size for size in environment.shape[:2])
    edges = np.cos(np.linspace(0, np.pi, rows + 1))
    cosine = 0.5 * (edges[:-1] + edges[1:])
    azimuth = (np.arange(columns) + 0.5) / columns * 2 * np.pi
    wi = oracles.spherical(cosine[:, None], azimuth[None])
    solid_angle = (edges[:-1] - edges[1:])[:, None] * np.full(columns, 2 * np.pi / columns)
    return wi.reshape(-1, 3), solid_angle.reshape(-1)


@dataclass(frozen=True)
class KnownBall:
    """A ball, its material as a function of the unit normal, and the surrounding light.

    Attributes:
        environment: the map (H, W, 3), linear radiance.
        base_color: unit normals (N, 3) to base colour (N, 3).
        roughness, metallic: the same at every point.
        lobe: "ggx" or "spherical_gaussian".
    """

    environment: Array = field(default_factory=sky)
    base_color: Callable[[Array], Array] = lambda n: 0.5 + 0.3 * n
    roughness: float = 0.35
    metallic: float = 0.0
    lobe: str = "ggx"

    def outgoing(self, n: Array, wo: Array, by_lobe: bool = True) -> Array:
        """Linear radiance (N, 3) towards unit `wo`: the rendering equation with the lobe of the ball.

        Args:
            n, wo: unit normals and directions to the viewer, (N, 3).
            by_lobe: the specular part is integrated over half vectors that follow the lobe, for smooth
                surfaces under smooth light; otherwise over the texels, for rough surfaces under a small sun.
        """
        b, r, m = self.base_color(n)[:, None], np.array(self.roughness), np.array(self.metallic)
        wi, solid_angle = texel_directions(self.environment)
        light = radiance_from(self.environment, wi) * solid_angle[:, None]
        arriving = np.maximum(n @ wi.T, 0) @ light
        result = (1 - m) / np.pi * b[:, 0] * arriving
        if by_lobe:
            return result + self._specular_by_lobe(n, wo, b, r, m)
        for rows in np.array_split(np.arange(len(n)), max(1, len(n) // 64)):
            _, specular = oracles.brdf(self.lobe, b[rows], r, m, n[rows, None], wo[rows, None], wi[None])
            cosine = np.maximum(n[rows] @ wi.T, 0)
            result[rows] += np.einsum("nkc,nk,kc->nc", specular, cosine, light)
        return result

    def _specular_by_lobe(self, n: Array, wo: Array, b: Array, r: Array, m: Array) -> Array:
        """∫ f_s L cos dwi as the mean of F G (wo·h)/(n·wo) D/p L over half vectors h of density p."""
        rng = np.random.default_rng(0)
        k = np.arange(SPECULAR_DIRECTIONS)
        u = (k + 0.5) / SPECULAR_DIRECTIONS
        if self.lobe == "ggx":
            # p = D (n·h)
            cosine = np.sqrt((1 - u) / (1 + (r**4 - 1) * u))
            ratio = 1 / cosine
        else:
            # p = D / (1 − e^(−2/r⁴))
            cosine = 1 + r**4 / 2 * np.log1p(u * np.expm1(-2 / r**4))
            ratio = np.full_like(cosine, -np.expm1(-2 / r**4))
        azimuth = k * np.pi * (3 - np.sqrt(5)) + 2 * np.pi * rng.random((len(n), 1))
        local = oracles.spherical(cosine[None], azimuth)
        aside = np.where(np.abs(n[:, :1]) < 0.7, [[1.0, 0, 0]], [[0, 1.0, 0]])
        tangent = np.cross(aside, n)
        tangent /= np.linalg.norm(tangent, axis=-1, keepdims=True)
        frame = np.stack((tangent, np.cross(n, tangent), n), 1)
        h = local @ frame
        towards = (h * wo[:, None]).sum(-1, keepdims=True)
        wi = 2 * towards * h - wo[:, None]
        cos_i, cos_o = ((v * n[:, None]).sum(-1, keepdims=True) for v in (wi, wo[:, None]))
        valid = (cos_i > 0) & (towards > 0)
        f0 = 0.04 * (1 - m) + b * m
        fresnel = f0 + (1 - f0) * (1 - towards.clip(0, 1)) ** 5
        masking = oracles.masking(self.lobe, np.where(valid, cos_i, 1.0), cos_o, r)
        weight = np.where(valid, fresnel * masking * towards / cos_o * ratio[:, None], 0.0)
        return (weight * radiance_from(self.environment, wi)).mean(1)


@dataclass(frozen=True)
class Photographed:
    """Pixels of the ball: rays (N, 3), their hits, and the observed radiance."""

    origins: Array
    directions: Array
    normal: Array
    color: Array


def photograph(ball: KnownBall, count: int, seed: int = 0, by_lobe: bool = True) -> Photographed:
    """Pixels of cameras all around whose rays hit the ball, none within 11° of its outline."""
    rng = np.random.default_rng(seed)
    origins = rng.normal(size=(count, 3))
    origins *= DISTANCE / np.linalg.norm(origins, axis=-1, keepdims=True)
    normal = rng.normal(size=(60 * count, 3))
    normal /= np.linalg.norm(normal, axis=-1, keepdims=True)
    normal = normal.reshape(count, 60, 3)
    to_camera = origins[:, None] - RADIUS * normal
    cosine = (normal * to_camera).sum(-1) / np.linalg.norm(to_camera, axis=-1)
    normal = normal[np.arange(count), (cosine > 0.2).argmax(1)]
    directions = RADIUS * normal - origins
    directions /= np.linalg.norm(directions, axis=-1, keepdims=True)
    assert ((-directions * normal).sum(-1) > 0.1).all()
    return Photographed(origins, directions, normal, ball.outgoing(normal, -directions, by_lobe))
