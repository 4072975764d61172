"""Sampling of a map times the cosine: densities, χ², and the noise of irradiance.

Between four neighbouring texels the density is linear in the cosine of the polar angle and in the azimuth, so
its mean over any cell there is its value in the middle. Cells are quarters of the areas between four texels.
"""

from __future__ import annotations

import math

import numpy as np
import pytest
import torch
from scipy import stats
from torch.nn.functional import normalize

from neilfpp_method.fields.direction_map import (
    direction_at,
    interpolation_solid_angles,
    polar_cosines,
    texel_centers,
    texel_solid_angles,
    weights_linear_in_cosine,
)
from neilfpp_method.fields.environment import EnvironmentLight
from neilfpp_method.fields.map_sampling import radiance_times_cosine
from neilfpp_method.shading.sampling import Technique

SIZES = [(2, 4), (16, 32), (33, 50), (48, 96), (60, 31)]
"""Maps whose cells have 1, 1, 2, 2 and 3 texels a side; cells at the edges may be cut."""
NORMALS = [(0.0, 0.0, 1.0), (0.0, 0.0, -1.0), (0.6, 0.64, 0.48)]


def values(height: int, width: int) -> torch.Tensor:
    """A dim map with one small sun."""
    torch.manual_seed(5)
    radiance = 0.1 + torch.rand(height, width)
    radiance[height // 3, width // 4] *= 500
    return radiance


def cell_edges(height: int) -> torch.Tensor:
    """Cosines of the polar angle of all rows, and those halfway between them, from 1 to −1; float64."""
    rows = polar_cosines(height).double()
    halfway = (rows[:-1] + rows[1:]) / 2
    return torch.cat((torch.stack((rows[:-1], halfway), 1).flatten(), rows[-1:]))


def probabilities(technique: Technique, height: int, width: int) -> np.ndarray:
    """Probability of each cell, for one point."""
    edges = cell_edges(height)
    middle = ((edges[:-1] + edges[1:]) / 2)[:, None].expand(-1, 2 * width).float()
    azimuth = (torch.arange(2 * width) + 0.5) * math.pi / width
    wi = direction_at(middle, azimuth.expand(middle.shape))
    pdf = technique.pdf(wi.view(1, -1, 3))[0].double().view(middle.shape)
    return (pdf * -edges.diff()[:, None] * math.pi / width).flatten().numpy()


def counts(wi: torch.Tensor, height: int, width: int) -> np.ndarray:
    """Number of directions in each cell, in the order of `probabilities`."""
    x, y, z = wi.reshape(-1, 3).double().unbind(-1)
    row = torch.searchsorted(-cell_edges(height), -z).clamp(1, 2 * height - 2) - 1
    turn = torch.atan2(x, y) / (2 * math.pi) % 1
    column = (turn * 2 * width).long().clamp_max(2 * width - 1)
    return np.bincount((row * 2 * width + column).numpy(), minlength=4 * (height - 1) * width)


@pytest.mark.parametrize("size", SIZES)
def test_weights_are_those_of_the_texels_and_their_integrals_are_known(size):
    assert interpolation_solid_angles(*size).sum().item() == pytest.approx(4 * math.pi, rel=1e-6)
    row, column = torch.cartesian_prod(torch.arange(size[0]), torch.arange(size[1])).unbind(1)
    at_texels = direction_at(polar_cosines(size[0])[row], 2 * math.pi * (column + 0.5) / size[1])
    texel, weight = weights_linear_in_cosine(at_texels[None], *size)
    own = (weight * (texel // size[1] == row)).sum(0)[0]
    torch.testing.assert_close(own, torch.ones_like(own), atol=2e-3, rtol=0)
    inside = (row > 0) & (row < size[0] - 1)
    own = (weight * (texel == row * size[1] + column)).sum(0)[0]
    torch.testing.assert_close(own[inside], torch.ones_like(own[inside]), atol=2e-3, rtol=0)

    torch.manual_seed(6)
    wi = normalize(torch.randn(1, 400_000, 3), dim=-1)
    texel, weight = weights_linear_in_cosine(wi, *size)
    torch.testing.assert_close(weight.sum(0), torch.ones_like(wi[..., 0]))
    found = torch.zeros(math.prod(size)).index_add(0, texel.flatten(), weight.flatten()) * 4 * math.pi / 4e5
    rows = found.view(size).sum(1), interpolation_solid_angles(*size).view(size).sum(1)
    torch.testing.assert_close(*rows, rtol=0.15, atol=1e-3)


@pytest.mark.parametrize("normal", NORMALS)
@pytest.mark.parametrize("size", SIZES)
def test_the_density_is_positive_above_the_horizon_and_integrates_to_one(size, normal):
    n = torch.tensor([normal])
    technique = radiance_times_cosine(values(*size), n)
    assert probabilities(technique, *size).sum() == pytest.approx(1, abs=1e-5)
    above = normalize(torch.randn(1, 20_000, 3), dim=-1)
    above = above * (above @ n[0] > 0).float().mul(2).sub(1)[..., None]
    assert technique.pdf(above).min() > 0


@pytest.mark.parametrize("count", [1, 16])
@pytest.mark.parametrize("normal", NORMALS)
@pytest.mark.parametrize("size", SIZES)
def test_directions_follow_the_density(size, normal, count):
    """χ² over the cells; with several strata each count varies less than Poisson's, so only
    from above.
    """
    torch.manual_seed(1)
    n = torch.tensor([normal]).expand(160_000 // count, 3)
    counted = counts(radiance_times_cosine(values(*size), n).draw(count, True), *size)
    expected = 160_000 * probabilities(radiance_times_cosine(values(*size), n[:1]), *size)
    rare = expected < 5
    counted = np.append(counted[~rare], counted[rare].sum())
    expected = np.append(expected[~rare], expected[rare].sum())
    statistic = ((counted - expected) ** 2 / np.maximum(expected, 1e-9)).sum()
    assert stats.chi2.sf(statistic, len(expected) - 1) > 1e-4


@pytest.mark.parametrize("normal", NORMALS)
def test_the_density_is_the_radiance_times_the_cosine(normal):
    """Away from the horizon, the density is proportional to radiance · cosine up to the height of a cell."""
    n, radiance = torch.tensor([normal]), values(16, 32)
    wi = normalize(torch.randn(1, 20_000, 3), dim=-1)
    cosine = (wi @ n[0])[0]
    texel, weight = weights_linear_in_cosine(wi, 16, 32)
    expected = (weight * radiance.flatten()[texel]).sum(0)[0] * cosine
    ratio = (radiance_times_cosine(radiance, n).pdf(wi)[0] / expected)[cosine > 0.5]
    assert (ratio / ratio.mean() - 1).abs().max() < 0.3


@pytest.mark.parametrize("size", [(16, 32), (48, 96)])
def test_a_sun_of_one_texel_has_little_noise(size):
    """What a surface facing the sun receives from it. Uniform directions within texels have noise of 0.88."""
    torch.manual_seed(3)
    light = EnvironmentLight(size[0], 1e-3)
    light.log_radiance[:, size[0] // 3, 5] = math.log(1e5)
    row, column = size[0] // 3, 5
    to_sun = direction_at(polar_cosines(size[0])[row], torch.tensor(2 * math.pi * (column + 0.5) / size[1]))
    n = to_sun.expand(4000, 3)
    technique = light.technique(n)
    wi = technique.draw(1, True)
    estimate = light.radiance(n, wi)[:, 0, 1] * (wi[:, 0] @ to_sun).clamp_min(0) / technique.pdf(wi)[:, 0]
    assert estimate.std() < 0.4 * estimate.mean()


@pytest.mark.parametrize("stochastic", [True, False])
def test_irradiance_has_little_noise(stochastic):
    """16 directions under a smooth sky with a sun."""
    torch.manual_seed(2)
    light = EnvironmentLight(48, 1.0)
    light.log_radiance.copy_((0.4 + 0.3 * texel_centers(48, 96)[:, 2].view(48, 96)).log().expand(3, -1, -1))
    light.log_radiance[:, 14:16, 20:22] = math.log(300.0)
    n = normalize(torch.randn(3000, 3), dim=-1)
    technique = light.technique(n)

    wi = texel_centers(192, 384)[None]
    weighted = light.radiance(n, wi)[0] * texel_solid_angles(192, 384)[:, None]
    truth = (n @ wi[0].t()).clamp_min(0) @ weighted
    drawn = technique.draw(16, stochastic)
    cosine = (drawn * n[:, None]).sum(-1).clamp_min(0)
    estimate = (light.radiance(n, drawn) * (cosine / technique.pdf(drawn))[..., None]).mean(1)
    error = (estimate / truth - 1)[:, 1]
    assert error.abs().median() < 0.02
    assert error.square().mean().sqrt() < 0.05
    assert error.mean().abs() < 5e-3


def test_a_large_map_costs_as_little_as_a_small_one():
    """The memory per point is that of the cells: a thousand points of a map with 524,288 texels."""
    even = torch.full((512, 1024), 1.0)
    technique = radiance_times_cosine(even, torch.eye(3)[:1].expand(1000, 3))
    wi = technique.draw(4, True)
    assert (technique.pdf(wi) > 0).all()
    assert ((wi[..., 0] > 0).float().mean() > 0.95).item()


@pytest.mark.parametrize("dtype", [torch.float64, torch.float32, torch.bfloat16])
def test_half_precision_normals(dtype):
    n = torch.tensor(NORMALS, dtype=dtype)
    technique = radiance_times_cosine(values(16, 32).to(dtype), n)
    wi = technique.draw(64, True)
    assert wi.dtype in (torch.float32, torch.float64)
    assert wi.isfinite().all()
    assert technique.pdf(wi).min() > 0


def test_tensors_kept_between_calls_can_be_differentiated_after_inference_mode():
    normal = torch.tensor([NORMALS[0]])
    with torch.inference_mode():
        radiance_times_cosine(values(7, 11), normal).pdf(texel_centers(7, 11)[None])
    radiance = values(7, 11).requires_grad_()
    assert radiance_times_cosine(radiance, normal).pdf(texel_centers(7, 11)[None]).isfinite().all()
    assert not texel_solid_angles(7, 11).is_inference()
