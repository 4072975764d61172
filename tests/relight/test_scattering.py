"""Sampled directions at a surface: their density, and the sum of their weights."""

from __future__ import annotations

import math

import numpy as np
import pytest
import torch

from neilfpp_method.relight.scattering import Vertices, brdf_cosine, scatter, scattering_pdf, vertices
from neilfpp_method.relight.surface import Intersections
from neilfpp_method.shading.brdf import GGX, LOBES, SPHERICAL_GAUSSIAN
from neilfpp_method.structures import Material
from tests import oracles

CASES = [
    (name, r, m) for name in ("ggx", "spherical_gaussian") for r, m in ((0.35, 0.0), (0.35, 1.0), (1.0, 0.3))
]


def at(
    count: int, lobe, roughness: float, metallic: float, cosine: float = 0.6, base: float = 0.7
) -> Vertices:
    wo = torch.tensor([[math.sqrt(1 - cosine**2), 0.0, cosine]]).expand(count, 3)
    up = torch.tensor([[0.0, 0.0, 1.0]]).expand(count, 3)
    one = torch.ones(count, 1)
    material = Material(base * one.expand(-1, 3), roughness * one, metallic * one)
    rows, all_of_them = torch.arange(count), torch.ones(count, dtype=torch.bool)
    hits = Intersections(rows, one[:, 0], torch.zeros(count, 3), up, up, all_of_them)
    return vertices(hits, wo, material, lobe)


@pytest.mark.parametrize(("name", "roughness", "metallic"), CASES)
def test_directions_have_the_reported_density(name, roughness, metallic):
    lobe = LOBES[name]
    u = torch.rand(100_000, 3, generator=torch.Generator().manual_seed(5))
    # χ² cells meet at the poles, so the viewer, against whom the density of the lobe is infinite, is one:
    # turn all to it.
    points, one = (
        at(len(u), lobe, roughness, metallic, cosine=1.0),
        at(1, lobe, roughness, metallic, cosine=1.0),
    )
    result = oracles.chi2_test(
        lambda: scatter(points, u, lobe).numpy(),
        lambda wi: scattering_pdf(spread(one, len(wi)), torch.from_numpy(wi).float(), lobe).double().numpy(),
        tests=len(CASES),
    )
    assert result.passed, result
    assert result.total == pytest.approx(1, abs=2e-3)


def spread(one: Vertices, count: int) -> Vertices:
    return one[torch.zeros(count, dtype=torch.int64)]


@pytest.mark.parametrize("cosine", [1.0, 0.6, 0.15])
@pytest.mark.parametrize(("name", "roughness", "metallic"), CASES)
def test_the_mean_weight_is_the_directional_albedo(name, roughness, metallic, cosine):
    lobe = LOBES[name]
    u = torch.quasirandom.SobolEngine(3, scramble=True, seed=1).draw(2**16)
    points = at(len(u), lobe, roughness, metallic, cosine)
    wi = scatter(points, u, lobe)
    # Far below the horizon the density of a narrow lobe underflows in float32, and the weight is undefined.
    weight = brdf_cosine(points, wi, lobe) / scattering_pdf(points, wi, lobe).clamp_min(1e-30)[:, None]
    # By Gauss-Legendre nodes in the cosine and an even spread in azimuth, from the formula as it is printed.
    nodes, weights = np.polynomial.legendre.leggauss(200)
    azimuth = 2 * np.pi * (np.arange(400) + 0.5) / 400
    grid = oracles.spherical(((nodes + 1) / 2)[:, None], azimuth[None])
    wo = np.array([math.sqrt(1 - cosine**2), 0.0, cosine])
    up = np.array([0.0, 0.0, 1.0])
    r, m = np.array([roughness]), np.array([metallic])
    diffuse, specular = oracles.brdf(name, np.array([0.7]), r, m, up, wo, grid)
    expected = ((diffuse + specular)[..., 0] * grid[..., 2] * weights[:, None] / 2 * 2 * np.pi / 400).sum()
    assert weight[:, 0].double().mean().item() == pytest.approx(expected, rel=5e-3)
    assert weight.max() < 12  # ten for the least share of a technique


def test_the_weight_of_a_lambertian_surface_is_its_color():
    points = at(1000, None, 0.5, 0.9)
    wi = scatter(points, torch.rand(1000, 3), None)
    weight = brdf_cosine(points, wi, None) / scattering_pdf(points, wi, None)[:, None]
    assert weight.numpy() == pytest.approx(0.7, rel=1e-4)  # metallic has no influence


@pytest.mark.parametrize("lobe", [GGX, SPHERICAL_GAUSSIAN, None])
def test_nothing_is_scattered_into_the_triangle(lobe):
    points = at(1, lobe, 0.5, 0.5)
    tilted = Vertices(**{**vars(points), "flat": torch.tensor([[0.6, 0.0, 0.8]])})
    wi = torch.nn.functional.normalize(
        torch.tensor([[-1.0, 0.0, 0.5]]), dim=-1
    )  # above the normal, within the triangle
    assert brdf_cosine(points, wi, lobe).amin() > 0
    assert not brdf_cosine(tilted, wi, lobe).any()
