"""All samplers estimate the same integral: white furnace, SciPy quadrature, gradcheck, and the explicit
sum.
"""

from __future__ import annotations

import numpy as np
import pytest
import torch

from neilfpp_method.shading.brdf import GGX, LOBES, SPHERICAL_GAUSSIAN, evaluate
from neilfpp_method.shading.rendering_equation import shade
from neilfpp_method.shading.sampling import Sampling, combine, fibonacci, sample_directions
from neilfpp_method.structures import Incident, IncidentSamples, Material
from tests import oracles

KINDS = ("fibonacci", "cosine", "lobe", "mis")
B, M = (0.7, 0.4, 0.1), 0.3
WO = (0.6, 0.0, 0.8)
# The smooth surface is a metal, because samples of only a narrow lobe hardly cover the
# diffuse part.
SURFACES = [(0.4, 1.0), (0.9, 0.3)]


def rows(values, count: int, dtype=torch.float64) -> torch.Tensor:
    return torch.tensor([values], dtype=dtype).expand(count, -1)


def sky(wi):
    """A smooth light, brighter towards one side, for NumPy and torch arrays."""
    return 1 + 0.5 * wi[..., 0] + 2 * wi[..., 1] ** 2


def random_scene(count: int = 5, samples: int = 16):
    torch.manual_seed(0)
    n, wo, wi = (torch.randn(*shape, 3).double() for shape in ((count,), (count,), (count, samples)))
    n, wo, wi = (v / v.norm(dim=-1, keepdim=True) for v in (n, wo, wi))
    wo = wo * (wo * n).sum(-1, keepdim=True).sign()
    material = Material(
        torch.rand(count, 3).double(),
        0.3 + 0.6 * torch.rand(count, 1).double(),
        torch.rand(count, 1).double(),
    )
    return (
        material,
        n,
        wo,
        IncidentSamples(wi, 0.1 + torch.rand(count, samples).double()),
        torch.rand_like(wi) * 3,
    )


@pytest.mark.parametrize("lobe", list(LOBES))
def test_is_the_mean_of_integrand_over_pdf(lobe):
    material, n, wo, samples, light = random_scene()
    f = evaluate(material, n, wo, samples.wi, LOBES[lobe])
    factor = light * ((samples.wi * n[:, None]).sum(-1).clamp_min(0) / samples.pdf)[..., None]
    shading = shade(material, n, wo, Incident.of(samples, light), LOBES[lobe])
    assert shading.diffuse.allclose((f.diffuse * factor).mean(1))
    assert shading.specular.allclose((f.specular * factor).mean(1))
    assert torch.equal(shading.color, shading.diffuse + shading.specular)


@pytest.mark.parametrize("count", [1, 2, 3, 4, 7, 32, 128, 256])
def test_white_furnace_is_exact_at_every_count(count):
    """The midpoint rule integrates the cosine exactly: under unit light the outgoing radiance of a Lambertian
    surface is its colour.
    """
    n = torch.nn.functional.normalize(torch.randn(10, 3, generator=torch.Generator().manual_seed(1)), dim=-1)
    material = Material(rows(B, 10, torch.float32), torch.ones(10, 1), torch.full((10, 1), M))
    samples = combine([(fibonacci(n), count)], stochastic=False)
    for specular, expected in ((True, (1 - M) * material.base_color), (False, material.base_color)):
        shading = shade(
            material, n, n, Incident.of(samples, torch.ones_like(samples.wi)), GGX if specular else None
        )
        assert (shading.diffuse - expected).abs().max() < 1e-6


@pytest.fixture(scope="module")
def truth():
    """∫ f L cos dwi of one channel by adaptive quadrature, per lobe and roughness."""
    n, wo = np.array([0.0, 0.0, 1.0]), np.array(WO)

    def integral(lobe: str, r: float, m: float) -> float:
        def integrand(wi):
            diffuse, specular = oracles.brdf(lobe, np.array([B[0]]), np.array([r]), np.array([m]), n, wo, wi)
            return float((diffuse + specular)[0] * sky(wi) * wi[2])

        return oracles.hemisphere_integral(integrand)

    return {(lobe, r, m): integral(lobe, r, m) for lobe in LOBES for r, m in SURFACES}


@pytest.mark.parametrize(("r", "m"), SURFACES)
@pytest.mark.parametrize("lobe", list(LOBES))
@pytest.mark.parametrize("kind", KINDS)
def test_every_sampler_estimates_the_same_integral(kind, lobe, r, m, truth):
    """Within four standard errors of the quadrature, and the standard error is small."""
    torch.manual_seed(2)
    count = 4000
    material = Material(rows(B, count), rows([r], count), rows([m], count))
    n, wo = rows((0.0, 0.0, 1.0), count), rows(WO, count)
    samples = sample_directions(Sampling(kind, 32, LOBES[lobe], stochastic=True), n, wo, material)
    light = sky(samples.wi)[..., None].expand_as(samples.wi)
    estimates = shade(material, n, wo, Incident.of(samples, light), LOBES[lobe]).color[:, 0]
    error = estimates.std().item() / count**0.5
    assert error < 0.01 * truth[lobe, r, m]
    assert abs(estimates.mean().item() - truth[lobe, r, m]) < 4 * error + 1e-4


@pytest.mark.parametrize("lobe", list(LOBES))
def test_midpoint_lattices_converge(lobe, truth):
    r, m = SURFACES[0]
    material = Material(rows(B, 1), rows([r], 1), rows([m], 1))
    n, wo = rows((0.0, 0.0, 1.0), 1), rows(WO, 1)
    for kind in ("fibonacci", "cosine", "mis"):
        samples = sample_directions(Sampling(kind, 4096, LOBES[lobe], stochastic=False), n, wo, material)
        light = sky(samples.wi)[..., None].expand_as(samples.wi)
        color = shade(material, n, wo, Incident.of(samples, light), LOBES[lobe]).color[0, 0].item()
        assert color == pytest.approx(truth[lobe, r, m], rel=2e-3)


def test_specular_furnace_of_a_smooth_metal():
    """D and V lose little energy at r = 0.2: under unit light the outgoing radiance of a white metal is
    nearly 1, by only lobe samples.
    """
    count = 2000
    torch.manual_seed(3)
    material = Material(rows((1.0, 1.0, 1.0), count), rows([0.2], count), rows([1.0], count))
    n = rows((0.0, 0.0, 1.0), count)
    for lobe in (SPHERICAL_GAUSSIAN, GGX):
        samples = sample_directions(Sampling("lobe", 64, lobe, stochastic=True), n, n, material)
        color = shade(material, n, n, Incident.of(samples, torch.ones_like(samples.wi)), lobe).color
        assert color.mean().item() == pytest.approx(1, abs=0.01)


@pytest.mark.parametrize("lobe", list(LOBES))
def test_gradcheck(lobe):
    material, n, wo, samples, light = random_scene(3, 4)

    def color(b, r, m, n, light):
        return shade(Material(b, r, m), n, wo, Incident.of(samples, light), LOBES[lobe]).color

    inputs = (material.base_color, material.roughness, material.metallic, n, light)
    assert torch.autograd.gradcheck(color, [t.requires_grad_() for t in inputs])


def test_gradient_of_the_estimate_is_the_gradient_of_the_integral(truth):
    """d/dr by lobe samples, whose density depends on r but has no gradient, compared with differences of
    quadratures.
    """
    torch.manual_seed(4)
    count, r, step = 4000, 0.6, 1e-2
    n, wo = rows((0.0, 0.0, 1.0), count), rows(WO, count)
    roughness = rows([r], count).clone().requires_grad_()
    material = Material(rows(B, count), roughness, rows([M], count))
    samples = sample_directions(Sampling("lobe", 32, GGX, stochastic=True), n, wo, material)
    light = sky(samples.wi)[..., None].expand_as(samples.wi)
    specular = shade(material, n, wo, Incident.of(samples, light), GGX).specular[:, 0]
    (gradient,) = torch.autograd.grad(specular.sum(), roughness)

    def integral(r: float) -> float:
        def integrand(wi):
            vectors = np.array([0.0, 0.0, 1.0]), np.array(WO), wi
            return (
                oracles.brdf("ggx", np.array([B[0]]), np.array([r]), np.array([M]), *vectors)[1][0]
                * sky(wi)
                * wi[2]
            )

        return oracles.hemisphere_integral(integrand)

    expected = (integral(r + step) - integral(r - step)) / (2 * step)
    error = gradient.std().item() / count**0.5
    assert abs(gradient.mean().item() - expected) < 4 * error + 1e-3


def test_half_precision_is_summed_in_float32():
    """2048 equal terms: a bfloat16 sum would stall after 256 of them."""
    count = 2048
    n = torch.tensor([[0.0, 0.0, 1.0]], dtype=torch.bfloat16)
    samples = combine([(fibonacci(n), count)], stochastic=False)
    light = torch.ones(1, count, 3, dtype=torch.bfloat16)
    material = Material(n.new_ones(1, 3), n.new_ones(1, 1), n.new_zeros(1, 1))
    with torch.autocast("cpu", dtype=torch.bfloat16):
        shading = shade(material, n, n, Incident.of(samples, light), None)
    assert shading.color.dtype == torch.float32
    assert shading.color.allclose(torch.ones(1, 3), atol=1e-5)
