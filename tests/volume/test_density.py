"""The Laplace density, against SciPy's distribution."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from scipy.stats import laplace

from neilfpp_method.errors import UserError
from neilfpp_method.volume.density import LaplaceDensity, laplace_density


@pytest.mark.parametrize("beta", [0.5, 0.1, 0.003])
def test_is_the_laplace_cdf_over_beta(beta):
    sdf = np.linspace(-6 * beta, 6 * beta, 101)
    expected = laplace.cdf(-sdf, scale=beta) / beta
    density = laplace_density(torch.from_numpy(sdf), torch.tensor(beta, dtype=torch.float64))
    np.testing.assert_allclose(density.numpy(), expected, rtol=1e-12)


def test_thin_air_keeps_its_relative_precision_in_float32():
    density = laplace_density(torch.tensor([4.0]), torch.tensor(0.1))
    assert density.item() == pytest.approx(0.5 * np.exp(-40.0) / 0.1, rel=1e-5)  # 2e-17, far below 1 − (1 − 2e-17)


def test_gradients():
    sdf = torch.tensor([-0.7, -0.05, 0.02, 0.9], dtype=torch.float64).repeat(2, 1).requires_grad_()
    beta = torch.tensor([[0.2], [0.05]], dtype=torch.float64, requires_grad=True)
    assert torch.autograd.gradcheck(laplace_density, (sdf, beta))


def test_slope_on_the_surface_is_that_of_the_laplace_density():
    sdf = torch.zeros(1, requires_grad=True)
    laplace_density(sdf, torch.tensor(0.1)).sum().backward()
    assert sdf.grad.item() == pytest.approx(-1.0 / (2 * 0.1**2))  # −α · 1/(2β)


def test_beta_starts_where_told_and_stays_above_its_floor():
    density = LaplaceDensity(beta_init=0.1, beta_floor=1e-4)
    assert density.beta().item() == pytest.approx(0.1)
    assert density(torch.zeros(1)).item() == pytest.approx(0.5 / 0.1)
    with torch.no_grad():
        density.above_floor.fill_(-0.2)
    assert density.beta().item() == pytest.approx(0.2 + 1e-4)


def test_beta_at_its_floor_is_refused():
    with pytest.raises(UserError, match="beta_init"):
        LaplaceDensity(beta_init=1e-4, beta_floor=1e-4)
