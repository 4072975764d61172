"""Every sampler draws from the density that it reports (χ²), and its lattice has the documented positions."""

from __future__ import annotations

import math
from dataclasses import replace

import pytest
import torch

from neilfpp_method.errors import UserError
from neilfpp_method.shading import sampling
from neilfpp_method.shading.brdf import GGX, LOBES, SPHERICAL_GAUSSIAN
from neilfpp_method.shading.sampling import (
    Sampling,
    Technique,
    combine,
    fibonacci,
    sample_directions,
    sphere_lattice,
)
from neilfpp_method.structures import Material
from tests import oracles

KINDS = ("fibonacci", "cosine", "lobe", "mis")
CASES = [(kind, "ggx", 0.5) for kind in ("fibonacci", "cosine")] + [
    (kind, lobe, r) for kind in ("lobe", "mis") for lobe in LOBES for r in (0.35, 0.6, 1.0)
]
# The viewer is at +z and the surface turns: at −wo, a pole of the χ² cells, the density of the lobe is
# infinite.
NORMALS = {"frontal": (0.0, 0.0, 1.0), "oblique": (0.8, 0.0, 0.6), "grazing": (0.0, 0.9992, 0.04)}
POINTS, PER_POINT = 20_000, 6


def points(n, wo, count: int, roughness: float = 0.5, metallic: float = 0.0):
    """Normals, directions to the viewer, and a grey material."""
    made_of = ((0.5, 0.5, 0.5), (roughness,), (metallic,))
    n, wo, *made_of = (torch.tensor([v], dtype=torch.float64).expand(count, -1) for v in (n, wo, *made_of))
    return n, wo, Material(*made_of)


def density(kind, lobe, wi, n, wo, material):
    r = material.roughness
    return {
        "fibonacci": lambda: sampling.pdf_fibonacci(wi, n),
        "cosine": lambda: sampling.pdf_cosine(wi, n),
        "lobe": lambda: sampling.pdf_specular_lobe(wi, n, wo, r, lobe),
        "mis": lambda: (
            0.5 * sampling.pdf_cosine(wi, n) + 0.5 * sampling.pdf_specular_lobe(wi, n, wo, r, lobe)
        ),
    }[kind]()


@pytest.mark.parametrize("view", NORMALS)
@pytest.mark.parametrize(("kind", "lobe", "r"), CASES)
def test_chi2(kind, lobe, r, view):
    torch.manual_seed(3)
    many = points(NORMALS[view], (0.0, 0.0, 1.0), POINTS, r)
    one = tuple(t[:1] for t in many)
    result = oracles.chi2_test(
        lambda: (
            sample_directions(Sampling(kind, PER_POINT, LOBES[lobe], stochastic=True), *many)
            .wi.reshape(-1, 3)
            .numpy()
        ),
        lambda wi: density(kind, LOBES[lobe], torch.from_numpy(wi)[None], *one)[0].numpy(),
        tests=len(CASES) * len(NORMALS),
    )
    assert result.passed, result
    assert result.total == pytest.approx(1, abs=1e-4)


@pytest.mark.parametrize("kind", KINDS)
def test_the_reported_pdf_is_the_density_at_the_directions(kind):
    torch.manual_seed(4)
    n, wo, material = points((0.6, 0.0, 0.8), (0.0, 0.6, 0.8), 5)
    samples = sample_directions(Sampling(kind, 16, GGX, stochastic=True), n, wo, material)
    assert torch.equal(samples.pdf, density(kind, GGX, samples.wi, n, wo, material))
    assert samples.wi.norm(dim=-1).allclose(torch.ones(5, 16, dtype=torch.float64))


@pytest.mark.parametrize("kind", KINDS)
def test_only_stochastic_directions_depend_on_the_seed(kind):
    scene = points((0.6, 0.0, 0.8), (0.0, 0.6, 0.8), 2)
    still = [sample_directions(Sampling(kind, 8, GGX, stochastic=False), *scene).wi for _ in range(2)]
    assert torch.equal(*still)
    moving = sample_directions(Sampling(kind, 8, GGX, stochastic=True), *scene).wi
    assert not torch.equal(moving[0], moving[1])
    torch.manual_seed(5)
    first = sample_directions(Sampling(kind, 8, GGX, stochastic=True), *scene).wi
    torch.manual_seed(5)
    assert torch.equal(first, sample_directions(Sampling(kind, 8, GGX, stochastic=True), *scene).wi)


def test_fibonacci_lies_at_cell_midpoints():
    n, _, _ = points((0.0, 0.0, 1.0), (0.0, 0.0, 1.0), 1)
    wi = combine([(fibonacci(n), 4)], stochastic=False).wi[0]
    assert wi[:, 2].allclose(torch.tensor([0.875, 0.625, 0.375, 0.125], dtype=torch.float64))
    azimuth = torch.atan2(wi[:, 1], wi[:, 0])
    golden = math.pi * (3 - math.sqrt(5))
    assert (azimuth[1:] - azimuth[:-1] - golden).cos().allclose(torch.ones(3, dtype=torch.float64))


@pytest.mark.parametrize("count", [1, 2, 3, 8, 9])
def test_mis_is_unbiased_for_odd_counts(count):
    """The mean of (n·wi)/pdf estimates ∫ n·wi dwi = π; with one sample the mixture has only the cosine."""
    torch.manual_seed(6)
    n, wo, material = points((0.0, 0.0, 1.0), (0.6, 0.0, 0.8), 20_000)
    samples = sample_directions(Sampling("mis", count, SPHERICAL_GAUSSIAN, stochastic=True), n, wo, material)
    assert samples.pdf.shape == (20_000, count)
    estimate = (samples.wi[..., 2].clamp_min(0) / samples.pdf).mean().item()
    assert estimate == pytest.approx(math.pi, rel=5e-3)


def test_samples_carry_no_gradient():
    n, wo, material = points((0.0, 0.0, 1.0), (0.6, 0.0, 0.8), 2)
    n, wo, roughness = (t.clone().requires_grad_() for t in (n, wo, material.roughness))
    material = replace(material, roughness=roughness)
    for light in (None, light_of(n)):
        samples = sample_directions(Sampling("mis", 8, GGX, stochastic=True), n, wo, material, light)
        assert not samples.wi.requires_grad
        assert not samples.pdf.requires_grad


def test_an_unknown_sampler_is_refused():
    with pytest.raises(UserError, match="choose fibonacci, cosine, lobe, mis or no_lobe"):
        sample_directions(Sampling("uniform", 4, GGX, stochastic=False), *points((0, 0, 1.0), (0, 0, 1.0), 1))


# ---------------------------------------------------------------------------------------- light that is known


def light_of(n):
    """Light from z > 0, 80 % of it at azimuths from 270° to 360°, whose edges are edges of the χ² cells."""

    def place(at):
        z, turn, choice = at.u, at.v, at.w
        azimuth = torch.where(choice < 0.8, math.pi * (1.5 + 0.5 * turn), 1.5 * math.pi * turn)
        sine = (1 - z * z).sqrt()
        return torch.stack((sine * azimuth.cos(), sine * azimuth.sin(), z), -1)

    def pdf(wi):
        x, y, z = wi.unbind(-1)
        quarter = 2 / math.pi
        return (z > 0) * torch.where((x > 0) & (y < 0), 0.8 * quarter, 0.2 * quarter / 3)

    return Technique(n, place, pdf)


@pytest.mark.parametrize("metallic", [0.0, 1.0])
@pytest.mark.parametrize("count", [1, 2, 3, 8, 9])
def test_mis_with_light_estimates_the_same_integral(count, metallic):
    torch.manual_seed(7)
    n, wo, material = points((0.0, 0.0, 1.0), (0.6, 0.0, 0.8), 100_000, metallic=metallic)
    samples = sample_directions(Sampling("mis", count, GGX, stochastic=True), n, wo, material, light_of(n))
    assert samples.pdf.shape == (100_000, count)
    estimate = (samples.wi[..., 2].clamp_min(0) / samples.pdf).mean().item()
    assert estimate == pytest.approx(math.pi, rel=2e-2)


@pytest.mark.parametrize(("metallic", "to_lobe"), [(0.0, 2), (1.0, 5)])
def test_the_density_of_mis_with_light_is_that_of_its_directions(metallic, to_lobe):
    """8 directions of roughness 0.6: 25 % and 29 % to the lobe of paint, 57 % to that of metal."""
    torch.manual_seed(8)
    n, wo, material = points(NORMALS["oblique"], (0.0, 0.0, 1.0), POINTS, 0.6, metallic)
    light, one = light_of(n), (n[:1], wo[:1], material[:1])
    share = to_lobe / 8

    def pdf(wi):
        wi = torch.from_numpy(wi)[None]
        return ((1 - share) * light.pdf(wi) + share * density("lobe", GGX, wi, *one))[0].numpy()

    result = oracles.chi2_test(
        lambda: (
            sample_directions(Sampling("mis", 8, GGX, stochastic=True), n, wo, material, light)
            .wi.reshape(-1, 3)
            .numpy()
        ),
        pdf,
    )
    assert result.passed, result
    assert result.total == pytest.approx(1, abs=1e-4)


def test_each_point_has_its_own_share_of_directions_in_the_lobe():
    """Of 64 directions, 16 to 48 are in the lobe: more for metal, and fewer for rough surfaces."""
    torch.manual_seed(9)
    n, wo, material = points((0.0, 0.0, 1.0), (0.6, 0.0, 0.8), 4)
    roughness, metallic = torch.tensor([[0.1, 0.1, 1.0, 0.6], [0.0, 1.0, 1.0, 1.0]]).double().unsqueeze(-1)
    material = replace(material, roughness=roughness, metallic=metallic)
    assert (64 * sampling.lobe_share(material)).round()[:, 0].tolist() == [18, 48, 16, 36]
    samples = sample_directions(Sampling("mis", 64, GGX, stochastic=True), n, wo, material, light_of(n))
    mirror = torch.tensor([-0.6, 0.0, 0.8], dtype=torch.float64)
    assert ((samples.wi @ mirror)[:2] > 0.99).sum(1).tolist() == pytest.approx([18, 48], abs=2)


# ------------------------------------------------------------------------------------------- the whole sphere


def test_a_lattice_of_the_sphere_is_spread_evenly():
    """∫ max(n·wi, 0) dwi = π for any n, with one set of directions; accurate to 4 % with 512 directions of
    the sphere.
    """
    torch.manual_seed(10)
    n = torch.nn.functional.normalize(torch.randn(50, 3, dtype=torch.float64), dim=-1)
    wi = sphere_lattice(512, n)
    assert wi.shape == (512, 3)
    assert wi.norm(dim=-1).allclose(torch.ones(512, dtype=torch.float64))
    estimate = 4 * math.pi * (n @ wi.T).clamp_min(0).mean(1)
    assert estimate.allclose(torch.full_like(estimate, math.pi), rtol=0.04)
    nearest = (wi @ wi.T - 2 * torch.eye(512)).amax(1).clamp(-1, 1).acos()
    assert nearest.min() > 0.05  # 512 random directions come as near as 0.005
