"""Independent references in float64 NumPy and SciPy: published formulas, quadrature, and statistics."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from scipy import integrate, special, stats

__all__ = ["ChiSquare", "brdf", "chi2_test", "distribution", "hemisphere_integral", "spherical"]

Array = np.ndarray


# ------------------------------------------------------------------------------------------------------- BRDF


def distribution(lobe: str, cos_h: Array, r: Array) -> Array:
    """D as in METHOD §1."""
    if lobe == "spherical_gaussian":
        return np.exp(2 / r**4 * (cos_h - 1)) / (np.pi * r**4)
    alpha = r**2
    return alpha**2 / (np.pi * (cos_h**2 * (alpha**2 - 1) + 1) ** 2)


def masking(lobe: str, cos_i: Array, cos_o: Array, r: Array) -> Array:
    """G without cancelled cosines; for GGX from Smith's Λ = (√(1 + α² tan²θ) − 1)/2."""
    if lobe == "spherical_gaussian":
        shadowing, occlusion = (2 * c / ((2 - r**2) * c + r**2) for c in (cos_i, cos_o))
        return shadowing * occlusion
    shadowing, occlusion = ((np.sqrt(1 + r**4 * (1 / c**2 - 1)) - 1) / 2 for c in (cos_i, cos_o))
    return 1 / (1 + shadowing + occlusion)


def brdf(lobe: str, b: Array, r: Array, m: Array, n: Array, wo: Array, wi: Array) -> tuple[Array, Array]:
    """f_d and f_s of METHOD §1 for vectors (..., 3) and scalars (..., 1); both zero below the horizon of
    wi. f_d of "ggx_burley" is that of Disney's BRDF.
    """
    cos_i, cos_o = (wi * n).sum(-1, keepdims=True), (wo * n).sum(-1, keepdims=True)
    above = cos_i > 0
    cos_i = np.where(above, cos_i, 1.0)
    h = (wi + wo) / np.linalg.norm(wi + wo, axis=-1, keepdims=True)
    f0 = 0.04 * (1 - m) + b * m
    fresnel = f0 + (1 - f0) * (1 - (wo * h).sum(-1, keepdims=True)) ** 5
    specular = (
        distribution(lobe, (h * n).sum(-1, keepdims=True), r) * fresnel * masking(lobe, cos_i, cos_o, r)
    )
    diffuse = (1 - m) / np.pi * b
    if lobe == "ggx_burley":
        diffuse = diffuse * burley(cos_i, cos_o, (wi * h).sum(-1, keepdims=True), r)
    return above * diffuse, above * specular / (4 * cos_i * cos_o)


def burley(cos_i: Array, cos_o: Array, cos_d: Array, r: Array) -> Array:
    """Disney's diffuse lobe relative to Lambert's, as refraction and retro-reflection (Burley 2015,
    "Extending the Disney BRDF to a BSDF", eq. 4).
    """
    grazing_i, grazing_o, retro = (1 - cos_i) ** 5, (1 - cos_o) ** 5, 2 * r * cos_d**2
    refracted = (1 - grazing_i / 2) * (1 - grazing_o / 2)
    return refracted + retro * (grazing_i + grazing_o + grazing_i * grazing_o * (retro - 1))


# ------------------------------------------------------------------------------------------------- quadrature


def spherical(cosine: Array, azimuth: Array) -> Array:
    """Unit vectors (..., 3) about +z."""
    sine = np.sqrt(np.maximum(1 - cosine**2, 0))
    return np.stack((sine * np.cos(azimuth), sine * np.sin(azimuth), cosine * np.ones_like(azimuth)), -1)


def hemisphere_integral(f: Callable[[Array], float]) -> float:
    """∫ f(w) dw over the hemisphere about +z, adaptive to 1e-5."""
    value, _ = integrate.dblquad(
        lambda azimuth, cosine: f(spherical(np.asarray(cosine), np.asarray(azimuth))),
        *(0, 1, 0, 2 * np.pi),
        epsabs=1e-5,
        epsrel=1e-5,
    )
    return value


# ------------------------------------------------------------------------------------------------- statistics


@dataclass(frozen=True)
class ChiSquare:
    """`p_value` of the samples under the density; `total` is the density's integral over the sphere."""

    p_value: float
    total: float
    passed: bool


def chi2_test(
    sample_fn: Callable[[], Array],
    pdf_fn: Callable[[Array], Array],
    tests: int = 1,
    significance: float = 0.01,
) -> ChiSquare:
    """Pearson's χ² test of directions (K, 3) against a density per steradian on the whole sphere.

    Cells are equal steps of the polar angle from +z and of azimuth; the density is integrated over each by
    12×12 Gauss-Legendre nodes, and cells that expect fewer than 5 samples are pooled. With several `tests`
    the significance of each is Šidák's 1 − (1 − significance)^(1/tests), so that all together fail by chance
    as rarely as one would.
    """
    cells = 32
    directions = sample_fn()
    polar = np.arccos(directions[:, 2].clip(-1, 1))
    azimuth = np.arctan2(directions[:, 1], directions[:, 0]) % (2 * np.pi)
    polar_edges, azimuth_edges = np.linspace(0, np.pi, cells + 1), np.linspace(0, 2 * np.pi, cells + 1)
    observed, _, _ = np.histogram2d(polar, azimuth, bins=(polar_edges, azimuth_edges))

    nodes, weights = special.roots_legendre(12)
    theta = (polar_edges[:-1, None] + (nodes + 1) / 2 * np.pi / cells)[:, :, None, None]
    phi = (azimuth_edges[:-1, None] + (nodes + 1) / 2 * 2 * np.pi / cells)[None, None]
    grid = spherical(np.cos(theta), phi)
    density = np.sin(theta) * pdf_fn(grid.reshape(-1, 3)).reshape(grid.shape[:-1])
    share = np.einsum("iajb,a,b->ij", density, weights, weights) * np.pi**2 / (2 * cells**2)

    expected = share * len(directions)
    rare = expected < 5
    observed = np.append(observed[~rare], observed[rare].sum())
    expected = np.append(expected[~rare], expected[rare].sum())
    # A pool without density holds no samples, or the statistic is infinite.
    statistic = ((observed - expected) ** 2 / np.maximum(expected, 1e-12)).sum()
    p_value = float(stats.chi2.sf(statistic, len(expected) - 1))
    return ChiSquare(p_value, float(share.sum()), p_value > 1 - (1 - significance) ** (1 / tests))
