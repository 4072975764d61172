"""The BRDF compared with a NumPy transcription and closed forms; reciprocity, white furnace, gradcheck."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from scipy import integrate, stats

from neilfpp_method.shading.brdf import LOBES, cosines, evaluate, normal_reflectance, roughness_floor
from neilfpp_method.structures import Material
from tests import oracles

N, S = 64, 33
lobes = pytest.mark.parametrize("lobe", list(LOBES))


def unit(*shape: int) -> torch.Tensor:
    v = torch.randn(*shape, 3, dtype=torch.float64)
    return v / v.norm(dim=-1, keepdim=True)


def upper(v: torch.Tensor, n: torch.Tensor) -> torch.Tensor:
    """v, mirrored to the side of n if necessary."""
    return v * (v * n).sum(-1, keepdim=True).sign()


@pytest.fixture
def scene():
    torch.manual_seed(0)
    n = unit(N)
    return n, upper(unit(N), n), unit(N, S)


def random_material() -> Material:
    rand = torch.rand(N, 5, dtype=torch.float64)
    return Material(rand[:, :3], 0.1 + 0.9 * rand[:, 3:4], rand[:, 4:])


@lobes
def test_agrees_with_the_published_formula(lobe, scene):
    n, wo, wi = scene
    material = random_material()
    value = evaluate(material, n, wo, wi, LOBES[lobe])
    b, r, m = (t.numpy()[:, None] for t in (material.base_color, material.roughness, material.metallic))
    diffuse, specular = oracles.brdf(lobe, b, r, m, n.numpy()[:, None], wo.numpy()[:, None], wi.numpy())
    np.testing.assert_allclose(value.diffuse.numpy(), diffuse, rtol=1e-12)
    np.testing.assert_allclose(value.specular.numpy(), specular, rtol=1e-8, atol=1e-14)


@lobes
def test_reciprocity(lobe, scene):
    n, wo, _ = scene
    wi = upper(unit(N), n)
    material = random_material()
    there, back = (evaluate(material, n, a, b[:, None], LOBES[lobe]) for a, b in ((wo, wi), (wi, wo)))
    assert there.specular.allclose(back.specular, rtol=1e-10)
    assert torch.equal(there.diffuse, back.diffuse)


def test_schlick_keeps_f0_near_the_normal():
    """At wo·h = 0.8, F0 = 0.04: 0.04 + 0.96 · 0.2⁵ = 0.0403; the misprint in the paper's supplement would
    give 0.69.
    """
    wo = torch.tensor([[0.6, 0.0, 0.8]], dtype=torch.float64)
    wi, n = wo.new_tensor([[[-0.6, 0.0, 0.8]]]), wo.new_tensor([[0.0, 0.0, 1.0]])
    material = Material(torch.zeros_like(n), n[:, 2:], n[:, :1])
    value = evaluate(material, n, wo, wi, LOBES["spherical_gaussian"]).specular
    # h = n: D = 1/π at r = 1; V = 1/(0.8 + 1)²
    assert value[0, 0, 0].item() == pytest.approx(0.0403072 / np.pi / 1.8**2, rel=1e-9)


def test_normal_reflectance():
    material = Material(
        torch.tensor([[0.9, 0.5, 0.1]]).expand(2, 3), torch.ones(2, 1), torch.tensor([[0.0], [1.0]])
    )
    assert normal_reflectance(material).allclose(torch.tensor([[0.04, 0.04, 0.04], [0.9, 0.5, 0.1]]))


def at(function, cos_h: float, r: float) -> float:
    return function(*(torch.tensor([[x]], dtype=torch.float64) for x in (cos_h, r))).item()


@pytest.mark.parametrize("r", [0.2, 0.5, 0.8, 1.0])
@pytest.mark.parametrize(
    ("lobe", "closed_form"),
    [("spherical_gaussian", lambda r: 1 - r**4 / 2 * (1 - np.exp(-2 / r**4))), ("ggx", lambda r: 1.0)],
)
def test_projected_area_of_the_microfacets(lobe, closed_form, r):
    """∫ D (n·h) dh = 2π ∫ D c dc."""
    area, _ = integrate.quad(
        lambda c: 2 * np.pi * c * at(LOBES[lobe].distribution, c, r), 0, 1, epsabs=1e-9, limit=200
    )
    assert area == pytest.approx(closed_form(r), abs=1e-7)


@pytest.mark.parametrize("r", [0.2, 0.5, 1.0])
@lobes
def test_half_vectors_are_sampled_from_their_density(lobe, r):
    """n·h compared with the cumulative distribution that SciPy integrates from `pdf_h`
    (Kolmogorov-Smirnov).
    """
    knots = 1 - np.linspace(0, 1, 20001)[::-1] ** 3
    roughness = torch.full((1, 1), r, dtype=torch.float64)
    density = 2 * np.pi * LOBES[lobe].pdf_h(torch.from_numpy(knots.copy())[None], roughness)[0].numpy()
    cumulative = integrate.cumulative_simpson(density, x=knots, initial=0)
    assert cumulative[-1] == pytest.approx(1, abs=1e-6)
    torch.manual_seed(1)
    drawn = LOBES[lobe].sample_cos_h(torch.rand(1, 20000, dtype=torch.float64), roughness)[0].numpy()
    assert stats.kstest(drawn, lambda c: np.interp(c, knots, cumulative)).pvalue > 1e-3


def test_white_furnace_of_the_diffuse_part(scene):
    """∫ f_d cos dwi = π f_d = (1 − m) b."""
    n, wo, wi = scene
    material = random_material()
    diffuse = evaluate(material, n, wo, upper(wi, n[:, None]), LOBES["ggx"]).diffuse
    expected = (1 - material.metallic) * material.base_color
    assert (np.pi * diffuse).allclose(expected[:, None].expand_as(diffuse), rtol=1e-12)


@lobes
def test_below_the_horizon_is_exactly_black(lobe, scene):
    n, wo, wi = scene
    value = evaluate(random_material(), n, wo, -upper(wi, n[:, None]), LOBES[lobe])
    assert value.diffuse.eq(0).all()
    assert value.specular.eq(0).all()


def test_without_specular_the_surface_is_lambertian(scene):
    n, wo, wi = scene
    material = random_material()
    value = evaluate(material, n, wo, upper(wi, n[:, None]), LOBES["ggx"], specular=False)
    assert value.diffuse.allclose((material.base_color / np.pi)[:, None].expand_as(wi))
    assert value.specular.eq(0).all()


def test_cosines_of_the_half_vector(scene):
    n, wo, wi = scene
    h = wi + wo[:, None]
    h = h / h.norm(dim=-1, keepdim=True)
    cos = cosines(n, wo, wi)
    assert cos.h.allclose((h * n[:, None]).sum(-1), atol=1e-9)
    assert cos.d.allclose((h * wi).sum(-1), atol=1e-9)


@lobes
def test_below_the_roughness_floor_the_lobe_is_constant(lobe):
    floor = roughness_floor(torch.float32)
    assert floor == pytest.approx(0.0442, abs=1e-4)
    one = torch.ones(1, 1)
    at_floor = LOBES[lobe].distribution(one, floor * one)
    assert torch.equal(LOBES[lobe].distribution(one, 1e-4 * one), at_floor)
    # D(1) = 1/(π r⁴) for both lobes
    assert at_floor.item() == pytest.approx(1 / (np.pi * floor**4), rel=1e-3)


@lobes
def test_gradcheck(lobe):
    torch.manual_seed(2)
    n = unit(3)
    wo, wi = upper(unit(3), n), unit(3, 4)
    material = (torch.rand(3, 3).double(), 0.3 + 0.6 * torch.rand(3, 1).double(), torch.rand(3, 1).double())

    def value(b, r, m, n):
        f = evaluate(Material(b, r, m), n, wo, wi, LOBES[lobe])
        return f.diffuse, f.specular

    assert torch.autograd.gradcheck(value, [t.requires_grad_() for t in (*material, n)])
