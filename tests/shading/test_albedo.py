"""Directional albedo compared with SciPy's quadrature of the published BRDF, at the corners of its tables,
and its gradient.
"""

from __future__ import annotations

import itertools

import numpy as np
import pytest
import torch

from neilfpp_method.shading.albedo import directional_albedo
from neilfpp_method.shading.brdf import GGX, LOBES, SPHERICAL_GAUSSIAN
from neilfpp_method.structures import Material
from tests import oracles

UP = torch.tensor([[0.0, 0.0, 1.0]])


def surface(b: float, r: float, m: float) -> Material:
    return Material(torch.full((1, 3), b), torch.full((1, 1), r), torch.full((1, 1), m))


def towards(cosine: float) -> torch.Tensor:
    return torch.tensor([[(1 - cosine**2) ** 0.5, 0.0, cosine]])


@pytest.mark.parametrize("lobe", list(LOBES))
@pytest.mark.parametrize(
    ("b", "r", "m", "cosine"), [(0.6, 0.5, 0.0, 0.9), (0.8, 0.3, 1.0, 0.5), (0.4, 0.8, 0.5, 0.3)]
)
def test_is_the_integral_of_the_brdf_and_the_cosine(lobe, b, r, m, cosine):
    n, wo = np.array([0.0, 0.0, 1.0]), towards(cosine)[0].double().numpy()
    one = lambda value: np.array([value])  # noqa: E731

    def integrand(wi: np.ndarray) -> float:
        diffuse, specular = oracles.brdf(lobe, one(b), one(r), one(m), n, wo, wi)
        return float((diffuse + specular)[0] * wi[2])

    expected = oracles.hemisphere_integral(integrand)
    found = directional_albedo(surface(b, r, m), UP, towards(cosine), LOBES[lobe])
    assert found[0].tolist() == pytest.approx([expected] * 3, rel=5e-3)


@pytest.mark.parametrize("lobe", list(LOBES))
def test_is_finite_and_positive_in_all_corners(lobe):
    for b, r, m, cosine in itertools.product((0.0, 1.0), (0.0, 1.0), (0.0, 1.0), (-0.2, 0.0, 1.0)):
        found = directional_albedo(surface(b, r, m), UP, towards(cosine), LOBES[lobe])
        assert torch.isfinite(found).all()
        assert (found >= 0).all()


def test_a_white_dielectric_reflects_more_than_all_light_and_a_white_metal_does_not():
    both = directional_albedo(surface(1.0, 0.3, 0.0), UP, UP, GGX)
    metal = directional_albedo(surface(1.0, 0.3, 1.0), UP, UP, GGX)
    assert (both > 1.02).all()
    assert (metal <= 1.0).all()


def test_gradients_reach_the_material_and_not_the_view():
    material = surface(0.5, 0.4, 0.5)
    leaves = [
        value.requires_grad_() for value in (material.base_color, material.roughness, material.metallic)
    ]
    wo = towards(0.6).requires_grad_()
    directional_albedo(material, UP, wo, SPHERICAL_GAUSSIAN).sum().backward()
    assert all(leaf.grad.abs().max() > 0 for leaf in leaves)
    assert wo.grad is None
