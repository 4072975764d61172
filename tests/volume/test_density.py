"""The Laplace density, compared with SciPy's distribution."""

from __future__ import annotations

import math

import numpy as np
import pytest
import torch
from scipy.integrate import quad
from scipy.stats import laplace

from neilfpp_method.errors import UserError
from neilfpp_method.volume.density import (
    LaplaceDensity,
    entering_depth,
    laplace_density,
    laplace_depth,
    optical_depth,
)


@pytest.mark.parametrize("beta", [0.5, 0.1, 0.003])
def test_is_the_laplace_cdf_over_beta(beta):
    sdf = np.linspace(-6 * beta, 6 * beta, 101)
    expected = laplace.cdf(-sdf, scale=beta) / beta
    density = laplace_density(torch.from_numpy(sdf), torch.tensor(beta, dtype=torch.float64))
    np.testing.assert_allclose(density.numpy(), expected, rtol=1e-12)


def test_low_density_keeps_its_relative_precision_in_float32():
    density = laplace_density(torch.tensor([4.0]), torch.tensor(0.1))
    assert density.item() == pytest.approx(
        0.5 * np.exp(-40.0) / 0.1, rel=1e-5
    )  # 2e-17, far below 1 − (1 − 2e-17)


def test_gradients_agree_with_differences():
    sdf = torch.tensor([-0.7, -0.05, 0.02, 0.9], dtype=torch.float64).repeat(2, 1).requires_grad_()
    beta = torch.tensor([[0.2], [0.05]], dtype=torch.float64, requires_grad=True)
    assert torch.autograd.gradcheck(laplace_density, (sdf, beta))


def test_slope_on_the_surface_is_that_of_the_laplace_density():
    sdf = torch.zeros(1, requires_grad=True)
    laplace_density(sdf, torch.tensor(0.1)).sum().backward()
    assert sdf.grad.item() == pytest.approx(-1.0 / (2 * 0.1**2))  # −α · 1/(2β)


@pytest.mark.parametrize("dtype", [torch.float64, torch.float32])
@pytest.mark.parametrize(
    "ends", [(0.5, 0.2), (0.3, -0.4), (-0.1, -2.0), (0.01, 0.0102), (-1e-4, 1e-4), (0.0, 0.0), (-3.0, 40.0)]
)
def test_depth_is_the_integral_of_the_density_of_a_linear_distance(ends, dtype):
    beta, width = 0.1, 0.7
    inner = (
        0.5 if ends[0] == ends[1] else np.clip(ends[0] / (ends[0] - ends[1]), 0.0, 1.0)
    )  # the kink of the density
    slope = ends[1] - ends[0]
    expected, _ = quad(
        lambda t: laplace.cdf(-(ends[0] + slope * t), scale=beta) / beta,
        0.0,
        1.0,
        points=[inner],
        epsabs=0.0,
        epsrel=1e-10,
    )
    found = laplace_depth(
        torch.tensor([ends], dtype=dtype), torch.tensor([[2.0, 2.0 + width]], dtype=dtype), torch.tensor(beta)
    )
    assert found.item() == pytest.approx(width * expected, rel=1e-6 if dtype is torch.float64 else 2e-5)


def test_depth_does_not_depend_on_the_cuts_of_a_linear_distance():
    cuts = torch.tensor([0.0, 0.1, 0.1, 0.33, 0.34, 0.9, 1.0], dtype=torch.float64)
    through = laplace_depth(0.4 - cuts, cuts, torch.tensor(0.05, dtype=torch.float64)).sum()
    ends = cuts[[0, -1]]
    torch.testing.assert_close(
        through, laplace_depth(0.4 - ends, ends, torch.tensor(0.05, dtype=torch.float64))[0]
    )


def test_depth_has_gradients_also_along_a_surface():
    sdf = torch.tensor([[0.3, 0.3, -0.2, -0.21, -0.21, 0.05]], dtype=torch.float64, requires_grad=True)
    cuts = torch.tensor([[0.0, 0.2, 0.5, 0.7, 1.0, 1.4]], dtype=torch.float64)
    beta = torch.tensor(0.2, dtype=torch.float64, requires_grad=True)
    assert torch.autograd.gradcheck(lambda s, b: laplace_depth(s, cuts, b), (sdf, beta))


# ------------------------------------------------------------------------------------------- entering density


@pytest.mark.parametrize("dtype", [torch.float64, torch.float32])
@pytest.mark.parametrize(
    "ends", [(0.5, 0.2), (0.3, -0.4), (-0.1, -2.0), (1e-4, -1e-4), (40.0, -3.0), (-30.0, -31.0)]
)
def test_entering_depth_is_the_integral_of_the_density_where_the_distance_falls(ends, dtype):
    beta = 0.1
    fall = ends[0] - ends[1]
    expected, _ = quad(
        lambda t: fall * laplace.cdf(fall * t - ends[0], scale=beta) / beta,
        0.0,
        1.0,
        points=[np.clip(ends[0] / fall, 0.0, 1.0)],
        epsabs=0.0,
        epsrel=1e-10,
    )
    found = entering_depth(torch.tensor([(50.0, *ends)], dtype=dtype), torch.tensor(beta))[0, 1]
    assert found.item() == pytest.approx(expected, rel=1e-6 if dtype is torch.float64 else 2e-5)


def test_entering_depth_is_zero_where_the_distance_rises():
    rising = torch.tensor([50.0, -0.3, -0.3, 0.0, 2.0], dtype=torch.float64)
    assert entering_depth(rising, torch.tensor(0.1, dtype=torch.float64)).tolist()[1:] == [0.0] * 3


@pytest.mark.parametrize("start", [0.3, 0.0, -0.3])
def test_a_ray_that_starts_near_or_in_a_surface_has_entered_it_before(start):
    from_start, from_afar = torch.tensor([start, start + 0.1]), torch.tensor([50.0, start, start + 0.1])
    beta = torch.tensor(0.1)
    assert entering_depth(from_start, beta).sum().item() == pytest.approx(
        entering_depth(from_afar, beta).sum().item()
    )


def test_the_depth_of_a_passing_ray_depends_on_its_smallest_distance_alone():
    """A small and a large sphere, passed at the same distance; the isotropic density tells them apart."""
    along = torch.linspace(-2.0, 2.0, 4001, dtype=torch.float64)
    beta, gap = torch.tensor(0.02, dtype=torch.float64), 0.03
    passed = torch.stack([(along.square() + (r + gap) ** 2).sqrt() - r for r in (0.1, 1.0)])
    depth = entering_depth(passed, beta).sum(-1)
    torch.testing.assert_close(depth, torch.full_like(depth, 0.5 * math.exp(-gap / beta.item())))
    isotropic = laplace_depth(passed, along.expand(2, -1), beta).sum(-1)
    assert isotropic[1] > 2.0 * isotropic[0] > 4.0 * depth[0]


def test_entering_depth_has_gradients():
    sdf = torch.tensor([[0.3, 0.1, -0.2, -0.21, 0.05, 0.01]], dtype=torch.float64, requires_grad=True)
    beta = torch.tensor(0.2, dtype=torch.float64, requires_grad=True)
    assert torch.autograd.gradcheck(entering_depth, (sdf, beta))


def test_the_kind_determines_the_depth():
    sdf, cuts, beta = torch.tensor([[0.2, -0.1]]), torch.tensor([[1.0, 3.0]]), torch.tensor(0.05)
    expected = {"isotropic": laplace_depth(sdf, cuts, beta), "entering": entering_depth(sdf, beta)}
    for kind, depth in expected.items():
        assert torch.equal(optical_depth(kind, sdf, cuts, beta), depth)


# ------------------------------------------------------------------------------------------------------ scale


def test_beta_starts_at_the_given_value_and_stays_above_its_floor():
    density = LaplaceDensity(beta_init=0.1, beta_floor=1e-4)
    assert density.beta().item() == pytest.approx(0.1)
    depth = optical_depth("isotropic", torch.zeros(1, 2), torch.tensor([[1.0, 3.0]]), density.beta())
    assert depth.item() == pytest.approx(2.0 * 0.5 / 0.1)
    with torch.no_grad():
        density.above_floor.fill_(-0.2)
    assert density.beta().item() == pytest.approx(0.2 + 1e-4)


def test_beta_at_its_floor_is_refused():
    with pytest.raises(UserError, match="beta_init"):
        LaplaceDensity(beta_init=1e-4, beta_floor=1e-4)


def test_a_limit_lowers_the_scale_but_not_below_its_floor():
    density = LaplaceDensity(0.1, beta_floor=1e-3)
    density.limit_(0.2)
    assert density.beta().item() == pytest.approx(0.1)
    density.limit_(0.02)
    assert density.beta().item() == pytest.approx(0.02)
    density.limit_(1e-6)
    assert density.beta().item() == pytest.approx(1e-3)
    density.limit_(math.inf)
    assert density.beta().item() == pytest.approx(1e-3)
