"""Sampling of a map times the cosine: densities, χ², and the noise of irradiance."""

from __future__ import annotations

import math

import numpy as np
import pytest
import torch
from scipy import stats
from torch.nn.functional import normalize

from neilfpp_method.fields.direction_map import texel_centers, texel_solid_angles, texels_of
from neilfpp_method.fields.environment import EnvironmentLight
from neilfpp_method.fields.map_sampling import radiance_times_cosine

SIZES = [(2, 4), (16, 32), (33, 50), (48, 96), (60, 31)]
"""Maps whose cells have 1, 1, 2, 2 and 3 texels a side; cells at the edges may be cut."""
NORMALS = [(0.0, 0.0, 1.0), (0.0, 0.0, -1.0), (0.6, 0.64, 0.48)]


def shares(height: int, width: int) -> torch.Tensor:
    """A dim map with one small sun."""
    torch.manual_seed(5)
    power = texel_solid_angles(height, width).view(height, width) * (0.1 + torch.rand(height, width))
    power[height // 3, width // 4] *= 500
    return power / power.sum()


def every_texel(height: int, width: int) -> torch.Tensor:
    return texel_centers(height, width)[None]


@pytest.mark.parametrize("normal", NORMALS)
@pytest.mark.parametrize("size", SIZES)
def test_the_density_is_positive_above_the_horizon_and_integrates_to_one(size, normal):
    n = torch.tensor([normal])
    technique = radiance_times_cosine(shares(*size), n)
    pdf = technique.pdf(every_texel(*size))[0]
    assert (pdf * texel_solid_angles(*size)).sum().item() == pytest.approx(1, abs=1e-5)
    above = normalize(torch.randn(1, 20_000, 3), dim=-1)
    above = above * (above @ n[0] > 0).float().mul(2).sub(1)[..., None]
    assert technique.pdf(above).min() > 0


@pytest.mark.parametrize("count", [1, 16])
@pytest.mark.parametrize("normal", NORMALS)
@pytest.mark.parametrize("size", SIZES)
def test_directions_follow_the_density(size, normal, count):
    """χ² over the texels; with several strata each count varies less than Poisson's, so only from above."""
    torch.manual_seed(1)
    n = torch.tensor([normal]).expand(160_000 // count, 3)
    technique = radiance_times_cosine(shares(*size), n)
    wi = technique.draw(count, True)
    counted = np.bincount(texels_of(wi, *size).reshape(-1).numpy(), minlength=math.prod(size))
    expected = (technique.pdf(every_texel(*size))[0] * texel_solid_angles(*size)).double().numpy() * 160_000
    rare = expected < 5
    counted = np.append(counted[~rare], counted[rare].sum())
    expected = np.append(expected[~rare], expected[rare].sum())
    statistic = ((counted - expected) ** 2 / np.maximum(expected, 1e-9)).sum()
    assert stats.chi2.sf(statistic, len(expected) - 1) > 1e-4


@pytest.mark.parametrize("normal", NORMALS)
def test_the_density_is_the_radiance_times_the_cosine(normal):
    """Away from the horizon, the density is proportional to share · cosine up to the height of a cell."""
    n, share = torch.tensor([normal]), shares(16, 32)
    wi = every_texel(16, 32)
    cosine = (wi @ n[0])[0]
    expected = (share.flatten() / texel_solid_angles(16, 32)) * cosine
    ratio = (radiance_times_cosine(share, n).pdf(wi)[0] / expected)[cosine > 0.5]
    assert (ratio / ratio.mean() - 1).abs().max() < 0.2


@pytest.mark.parametrize("stochastic", [True, False])
def test_irradiance_has_little_noise(stochastic):
    """16 directions under a smooth sky with a sun."""
    torch.manual_seed(2)
    light = EnvironmentLight(48, 1.0)
    light.log_radiance.copy_((0.4 + 0.3 * texel_centers(48, 96)[:, 2].view(48, 96)).log().expand(3, -1, -1))
    light.log_radiance[:, 14:16, 20:22] = math.log(300.0)
    n = normalize(torch.randn(3000, 3), dim=-1)
    technique = light.technique(n)

    wi = every_texel(192, 384)
    weighted = light.radiance(n, wi)[0] * texel_solid_angles(192, 384)[:, None]
    truth = (n @ wi[0].t()).clamp_min(0) @ weighted
    drawn = technique.draw(16, stochastic)
    cosine = (drawn * n[:, None]).sum(-1).clamp_min(0)
    estimate = (light.radiance(n, drawn) * (cosine / technique.pdf(drawn))[..., None]).mean(1)
    error = (estimate / truth - 1)[:, 1]
    assert error.abs().median() < 0.06
    assert error.square().mean().sqrt() < 0.12
    assert error.mean().abs() < 5e-3


def test_a_large_map_costs_as_little_as_a_small_one():
    """The memory per point is that of the cells: a thousand points of a map with 524,288 texels."""
    share = torch.full((512, 1024), 1.0)
    technique = radiance_times_cosine(share, torch.eye(3)[:1].expand(1000, 3))
    wi = technique.draw(4, True)
    assert (technique.pdf(wi) > 0).all()
    assert ((wi[..., 0] > 0).float().mean() > 0.95).item()


@pytest.mark.parametrize("dtype", [torch.float64, torch.float32, torch.bfloat16])
def test_half_precision_normals(dtype):
    n = torch.tensor(NORMALS, dtype=dtype)
    technique = radiance_times_cosine(shares(16, 32).to(dtype), n)
    wi = technique.draw(64, True)
    assert wi.dtype in (torch.float32, torch.float64)
    assert wi.isfinite().all()
    assert technique.pdf(wi).min() > 0


def test_tensors_kept_between_calls_can_be_differentiated_after_inference_mode():
    normal = torch.tensor([NORMALS[0]])
    with torch.inference_mode():
        radiance_times_cosine(shares(7, 11), normal).pdf(every_texel(7, 11))
    share = shares(7, 11).requires_grad_()
    assert radiance_times_cosine(share, normal).pdf(every_texel(7, 11)).isfinite().all()
    assert not texel_solid_angles(7, 11).is_inference()
