"""Samplers of narrow lobes, and those of the path tracer, compared with the densities that they report, with
a million directions each (χ², Šidák-corrected).

A lobe of roughness 0.1 lies within one cell of `oracles.chi2_test`. So angles from its axis are stretched
logarithmically before directions are counted, and the density is that of the stretched directions.
"""

from __future__ import annotations

import math
from collections.abc import Callable

import numpy as np
import pytest
import torch
from scipy import stats

from neilfpp_method.relight.scattering import Vertices, scatter, scattering_pdf
from neilfpp_method.relight.sky import Sky
from neilfpp_method.shading import Sampling, sample_directions
from neilfpp_method.shading.brdf import LOBES
from tests import oracles
from tests.relight.test_scattering import at, spread
from tests.relight.test_sky import LAYOUTS, uneven
from tests.shading.test_sampling import NORMALS, density, points

SAMPLES = 1_000_000
NARROW = 0.1
"""Roughness of the narrow lobes."""
STRETCH = 200.0
"""Angles up to about 1/STRETCH are magnified evenly: the lobe of roughness 0.1 covers a dozen cells."""
PER_POINT = {"lobe": 1, "mis": 2}
SHADING = [(kind, lobe, view) for kind in PER_POINT for lobe in LOBES for view in ("frontal", "oblique")]
SCATTERING = [
    (lobe, roughness, metallic, cosine)
    for lobe in LOBES
    for roughness, metallic in ((NARROW, 0.0), (NARROW, 1.0), (0.35, 0.5), (1.0, 0.3))
    for cosine in (1.0, 0.6)
]
TESTS = len(SHADING) + len(SCATTERING) + len(LAYOUTS)
"""Tests of this module: all of them together fail by chance once in a hundred times."""

Directions = np.ndarray
"""Unit vectors, (K, 3)."""


def chi2_about(
    axis: tuple[float, float, float],
    drawn: Directions,
    pdf: Callable[[Directions], np.ndarray],
) -> oracles.ChiSquare:
    """The χ² test of directions against a density per steradian, both stretched about an axis."""
    third = np.asarray(axis) / np.linalg.norm(axis)
    first = np.cross(third, [0.0, 1.0, 0.0] if abs(third[1]) < 0.9 else [1.0, 0.0, 0.0])
    first /= np.linalg.norm(first)
    frame = np.stack((first, np.cross(third, first), third))
    scale = math.log1p(STRETCH * math.pi) / math.pi

    def turned(directions: Directions, new_angle: Callable[[np.ndarray], np.ndarray]) -> Directions:
        """Directions of the frame with other angles from its axis."""
        across = np.hypot(directions[:, 0], directions[:, 1])
        angle = new_angle(np.arctan2(across, directions[:, 2]))
        ratio = np.sin(angle) / np.maximum(across, 1e-30)
        return np.stack((ratio * directions[:, 0], ratio * directions[:, 1], np.cos(angle)), -1)

    def stretched_density(directions: Directions) -> np.ndarray:
        # p'(w') = p(w) sin θ dθ / (sin θ' dθ')
        stretched = np.arctan2(np.hypot(directions[:, 0], directions[:, 1]), directions[:, 2])
        angle = np.expm1(scale * stretched) / STRETCH
        slope = scale * (angle + 1 / STRETCH)
        narrow = turned(directions, lambda angle: np.expm1(scale * angle) / STRETCH)
        return pdf(narrow @ frame) * np.sin(angle) * slope / np.sin(stretched)

    local = drawn.astype(np.float64) @ frame.T
    return oracles.chi2_test(
        lambda: turned(local, lambda angle: np.log1p(STRETCH * angle) / scale), stretched_density, TESTS
    )


@pytest.mark.hard
@pytest.mark.parametrize(("kind", "lobe", "view"), SHADING)
def test_a_million_directions_of_a_narrow_lobe(kind, lobe, view):
    torch.manual_seed(11)
    normal, viewer = NORMALS[view], (0.0, 0.0, 1.0)
    many = points(normal, viewer, SAMPLES // PER_POINT[kind], NARROW)
    one = tuple(t[:1] for t in many)
    drawn = sample_directions(Sampling(kind, PER_POINT[kind], LOBES[lobe], stochastic=True), *many).wi
    result = chi2_about(
        mirrored(viewer, normal),
        drawn.reshape(-1, 3).numpy(),
        lambda wi: density(kind, LOBES[lobe], torch.from_numpy(wi)[None], *one)[0].numpy(),
    )
    assert result.passed, result
    assert result.total == pytest.approx(1, abs=2e-3)


@pytest.mark.hard
@pytest.mark.parametrize(("name", "roughness", "metallic", "cosine"), SCATTERING)
def test_a_million_directions_of_the_path_tracer(name, roughness, metallic, cosine):
    lobe, u = LOBES[name], torch.rand(SAMPLES, 3, generator=torch.Generator().manual_seed(5))
    many, one = (in_double(at(count, lobe, roughness, metallic, cosine)) for count in (SAMPLES, 1))
    result = chi2_about(
        mirrored(tuple(one.wo[0].tolist()), (0.0, 0.0, 1.0)),
        scatter(many, u.double(), lobe).numpy(),
        lambda wi: scattering_pdf(spread(one, len(wi)), torch.from_numpy(wi), lobe).numpy(),
    )
    assert result.passed, result
    assert result.total == pytest.approx(1, abs=2e-3)


@pytest.mark.hard
@pytest.mark.parametrize("layout", LAYOUTS)
def test_a_million_directions_of_the_map_of_the_path_tracer(layout):
    """The cells are the texels of the map, on each of which the density is constant."""
    sky = Sky(uneven(), *LAYOUTS[layout])
    height, width = sky.radiance.shape[:2]
    # Polar angles of the edges between rows; the first and last row may be the poles.
    rows = np.arange(1, height)
    inner = (rows - 0.5) / (height - 1) if sky.rows_at_poles else rows / height
    edges = math.pi * np.concatenate(([0.0], inner, [1.0]))
    polar = (edges[:-1] + edges[1:]) / 2
    azimuth = sky.start + 2 * math.pi * (np.arange(width) + 0.5) / width
    sine = np.sin(polar)[:, None]
    middle = np.stack(
        np.broadcast_arrays(np.sin(azimuth) * sine, np.cos(azimuth) * sine, np.cos(polar)[:, None]), -1
    )
    solid_angle = -np.diff(np.cos(edges))[:, None] * 2 * math.pi / width
    pdf = sky.pdf(torch.from_numpy(middle.reshape(-1, 3)).float()).double().numpy().reshape(height, width)
    share = pdf * solid_angle
    assert share.sum() == pytest.approx(1, abs=1e-5)
    wi = sky.sample(torch.rand(SAMPLES, 2, generator=torch.Generator().manual_seed(0))).wi.double().numpy()
    turns = (np.arctan2(wi[:, 0], wi[:, 1]) - sky.start) / (2 * math.pi)
    drawn, _, _ = np.histogram2d(
        np.arctan2(np.hypot(wi[:, 0], wi[:, 1]), wi[:, 2]),
        turns % 1,
        bins=(edges, np.linspace(0, 1, width + 1)),
    )
    assert drawn.sum() == SAMPLES
    p_value = stats.chisquare(drawn.reshape(-1), (share / share.sum()).reshape(-1) * SAMPLES).pvalue
    assert p_value > 1 - 0.99 ** (1 / TESTS)


def mirrored(wo: tuple[float, float, float], normal: tuple[float, float, float]) -> tuple[float, ...]:
    cosine = sum(a * b for a, b in zip(wo, normal, strict=True))
    return tuple(2 * cosine * b - a for a, b in zip(wo, normal, strict=True))


def in_double(vertices: Vertices) -> Vertices:
    """In float32 angles below 3e-4 from the axis are lost in the cosine."""
    return Vertices(**{name: value.double() for name, value in vars(vertices).items()})
