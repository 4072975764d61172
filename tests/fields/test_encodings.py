"""Encodings compared with SciPy, closed forms and autograd."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from scipy.special import roots_legendre, sph_harm_y

from neilfpp_method.errors import UserError
from neilfpp_method.fields.encodings import FrequencyEncoding, HashGrid, Raw, SphericalHarmonics, pull_back
from neilfpp_method.kernels import grid_spec

GRID = grid_spec(levels=3, log2_entries=8, max_resolution=16, base_resolution=2)


def positions(count: int = 6) -> torch.Tensor:
    return torch.empty(count, 3, dtype=torch.float64).uniform_(
        -1, 1, generator=torch.Generator().manual_seed(2)
    )


def sphere_quadrature() -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Polar angle, azimuth and weight; exact for polynomials of degree 15 in x, y, z."""
    z, w = roots_legendre(8)
    theta, phi = np.meshgrid(np.arccos(z), 2 * np.pi * np.arange(16) / 16, indexing="ij")
    return theta.ravel(), phi.ravel(), np.repeat(w * 2 * np.pi / 16, 16)


def directions(theta: np.ndarray, phi: np.ndarray) -> torch.Tensor:
    return torch.from_numpy(
        np.stack((np.sin(theta) * np.cos(phi), np.sin(theta) * np.sin(phi), np.cos(theta)), -1)
    )


def test_spherical_harmonics_are_orthonormal():
    theta, phi, weight = sphere_quadrature()
    y = SphericalHarmonics(5)(directions(theta, phi)).numpy()
    np.testing.assert_allclose(y.T @ (weight[:, None] * y), np.eye(25), atol=1e-12)


def test_spherical_harmonics_agree_with_scipy():
    theta, phi, _ = sphere_quadrature()
    expected = []
    for band in range(5):
        for m in range(-band, band + 1):
            value = (-1.0) ** m * sph_harm_y(
                band, abs(m), theta, phi
            )  # (−1)^m takes the Condon–Shortley phase away
            expected.append(value.real if m == 0 else np.sqrt(2) * (value.real if m > 0 else value.imag))
    np.testing.assert_allclose(
        SphericalHarmonics(5)(directions(theta, phi)).numpy(), np.stack(expected, -1), atol=1e-12
    )


@pytest.mark.parametrize("degree", [1, 2, 3, 4, 5])
def test_fewer_bands_are_the_first_ones(degree):
    x = directions(*sphere_quadrature()[:2])
    encoding = SphericalHarmonics(degree)
    assert encoding.width == degree**2
    assert torch.equal(encoding(x), SphericalHarmonics(5)(x)[:, : degree**2])


@pytest.mark.parametrize("degree", [0, 6])
def test_an_unsupported_number_of_bands_is_refused(degree):
    with pytest.raises(UserError, match="bands"):
        SphericalHarmonics(degree)


def test_frequency_encoding_of_a_point():
    got = FrequencyEncoding(2)(torch.tensor([[0.1, 0.2, 0.3]], dtype=torch.float64))[0]
    once, twice = np.array([0.1, 0.2, 0.3]), np.array([0.2, 0.4, 0.6])
    expected = np.concatenate((once, np.sin(once), np.sin(twice), np.cos(once), np.cos(twice)))
    np.testing.assert_allclose(got.numpy(), expected)
    assert FrequencyEncoding(6).width == 3 * (1 + 2 * 6)


@pytest.mark.parametrize("encoding", [Raw(), FrequencyEncoding(5), HashGrid(GRID, radius=1.75).double()])
def test_jacobian_is_the_derivative(encoding):
    x = positions().requires_grad_()
    encoded = encoding.with_jacobian(x)
    assert torch.equal(encoded.features, encoding(x))
    assert encoded.features.shape == (6, encoding.width)
    rows = [torch.autograd.grad(f, x, retain_graph=True)[0] for f in encoded.features.sum(0)]
    torch.testing.assert_close(encoded.jacobian, torch.stack(rows, 1))


def test_pull_back_is_the_chain_rule():
    encoding, x = FrequencyEncoding(3), positions().requires_grad_()
    encoded = encoding.with_jacobian(x)
    rows = torch.randn(6, 2, encoding.width, dtype=torch.float64, generator=torch.Generator().manual_seed(3))
    outputs = (rows * encoded.features[:, None]).sum(-1)
    expected = torch.stack([torch.autograd.grad(o, x, retain_graph=True)[0] for o in outputs.sum(0)], 1)
    torch.testing.assert_close(pull_back(rows, encoded), expected)


def test_the_cube_of_the_grid_contains_the_scene_sphere():
    """Its faces are at −radius and +radius: the derivative across them vanishes only there and beyond."""
    grid = HashGrid(GRID, radius=2.0).double()
    x = torch.tensor([[-1.999, 0.3, 0.1], [1.999, 0.3, 0.1], [2.001, 0.3, 0.1]], dtype=torch.float64)
    along_x = grid.with_jacobian(x).jacobian[:, 3:, 0].abs().sum(1)
    assert (along_x > 0).tolist() == [True, True, False]
    assert grid.table.abs().max() <= 1e-4
    assert grid.step == pytest.approx(2 * 2.0 / 16)
