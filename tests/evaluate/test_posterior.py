"""The posterior of a material, compared with closed forms and with an exhaustive search over all
parameters.
"""

from __future__ import annotations

import math
from dataclasses import replace

import pytest
import torch

from neilfpp_method.evaluate.posterior import (
    ROUGHNESS_NODES,
    Deviation,
    Observations,
    RadianceParts,
    expected_error,
    prior_error,
)
from neilfpp_method.structures import Material

R = len(ROUGHNESS_NODES)


def material(base_color: float = 0.5, roughness: float = 0.5, metallic: float = 0.0) -> Material:
    return Material(
        torch.full((1, 3), base_color), torch.full((1, 1), roughness), torch.full((1, 1), metallic)
    )


def lambertian(views: int, diffuse: float = 1.0) -> RadianceParts:
    """Uniform light, so that D is `diffuse`, without a specular part."""
    nothing = torch.zeros(1, views, R, 3)
    return RadianceParts(torch.full_like(nothing, diffuse), nothing, nothing)


def sights(radiance: torch.Tensor, noise: float, shared: torch.Tensor | None = None) -> Observations:
    """Observations of one point, equal in all views and channels."""
    views = len(radiance)
    value = radiance[None, :, None].expand(1, views, 3)
    shared = torch.zeros(views, 1) if shared is None else shared
    return Observations(
        torch.ones(1, views, dtype=torch.bool),
        value,
        torch.full_like(value, noise),
        shared[None, :, None].expand(1, -1, 3, -1),
    )


def numbers(deviation: Deviation) -> tuple[float, float, float]:
    return deviation.base_color.item(), deviation.roughness.item(), deviation.metallic.item()


# ----------------------------------------------------------------------------------------------- closed forms


@pytest.mark.parametrize("views", [1, 4, 16])
@pytest.mark.parametrize("diffuse", [0.5, 2.0])
def test_a_lambertian_surface_has_the_error_of_the_mean_over_views(views, diffuse):
    seen = sights(torch.full((views,), 0.5 * diffuse), 0.02)
    base_color = numbers(expected_error(lambertian(views, diffuse), seen, material(), specular=False))[0]
    assert base_color == pytest.approx(0.02 / diffuse / math.sqrt(views), rel=1e-2)


def test_an_estimate_that_contradicts_the_views_has_that_error():
    seen = sights(torch.full((4,), 0.7), 0.02)
    base_color = numbers(expected_error(lambertian(4), seen, material(0.5), specular=False))[0]
    assert base_color == pytest.approx(math.hypot(0.2, 0.01), rel=1e-2)


def test_more_views_do_not_reduce_a_shared_error():
    for views in (1, 16, 64):
        seen = sights(torch.full((views,), 0.5), 1e-3, torch.full((views, 1), 0.1))
        assert numbers(expected_error(lambertian(views), seen, material(), specular=False))[
            0
        ] == pytest.approx(0.1, rel=2e-2)


def test_a_view_without_the_shared_error_determines_the_base_color():
    # The shared error does not affect the second view, so this view determines the base colour.
    seen = sights(torch.tensor([0.5, 0.5]), 0.01, torch.tensor([[0.3], [0.0]]))
    assert numbers(expected_error(lambertian(2), seen, material(), specular=False))[0] == pytest.approx(
        0.01, rel=1e-2
    )


@pytest.mark.parametrize("estimate", [(0.5, 0.5, 0.5), (0.9, 0.1, 0.0)])
def test_a_point_without_views_has_the_error_under_the_prior(estimate):
    seen = replace(sights(torch.full((3,), 0.4), 0.01), visible=torch.zeros(1, 3, dtype=torch.bool))
    looks = RadianceParts(torch.ones(1, 3, R, 3), torch.rand(1, 3, R, 3), torch.rand(1, 3, R, 3))
    base_color, roughness, metallic = numbers(expected_error(looks, seen, material(*estimate)))
    assert base_color == pytest.approx(math.sqrt(1 / 12 + (estimate[0] - 0.5) ** 2), rel=1e-2)
    assert roughness == pytest.approx(math.sqrt(1 / 12 + (estimate[1] - 0.5) ** 2), rel=1e-2)
    # The variance of the arcsine distribution is 1/8; on a grid that contains 0 and 1 it is slightly
    # larger.
    assert 1 / 8 < metallic**2 - (estimate[2] - 0.5) ** 2 < 0.15
    guess = numbers(prior_error(material(*estimate)))
    assert guess == pytest.approx(
        (base_color, roughness, math.hypot(math.sqrt(1 / 8), estimate[2] - 0.5)), rel=1e-2
    )


def test_base_color_stays_between_black_and_white():
    # Radiance of twice the maximum, without noise: the base colour is 1, without uncertainty.
    seen = sights(torch.full((4,), 2.0), 1e-3)
    assert numbers(expected_error(lambertian(4), seen, material(1.0), specular=False))[0] < 1e-3
    assert numbers(expected_error(lambertian(4), seen, material(0.0), specular=False))[0] == pytest.approx(
        1.0, abs=1e-3
    )


# ------------------------------------------------------------------------------------------------ brute force


def random_point(views: int = 5) -> tuple[RadianceParts, Observations]:
    torch.manual_seed(3)
    falling = torch.linspace(2.0, 0.1, R)[:, None] * (0.3 + torch.rand(1, views, 1, 1))
    looks = RadianceParts(
        0.6 + 0.2 * torch.rand(1, views, R, 1) * torch.ones(3),
        falling * torch.ones(3),
        0.2 * falling.square() * torch.ones(3),
    )
    shared = 0.05 * torch.rand(1, views, 3, 2)
    return looks, Observations(
        torch.ones(1, views, dtype=torch.bool),
        0.3 + 0.3 * torch.rand(1, views, 3),
        torch.full((1, views, 3), 0.1),
        shared,
    )


def test_agrees_with_an_exhaustive_search():
    looks, seen = random_point()
    estimate = material(0.4, 0.3, 0.2)
    got = numbers(expected_error(looks, seen, estimate))

    r = (torch.arange(20) + 0.5) / 20
    nodes = torch.tensor(ROUGHNESS_NODES)
    m = torch.linspace(0, 1, 9)
    prior = torch.linspace(0, 1, 10).sqrt().asin().diff()
    b = (torch.arange(400) + 0.5) / 400
    d, f, g = (torch.zeros(len(r), 5) for _ in range(3))
    density, second = torch.ones(len(r), len(m)), torch.zeros(len(r), len(m))
    for c in range(3):
        for v in range(5):
            for out, part in ((d, looks.diffuse), (f, looks.facing), (g, looks.grazing)):
                out[:, v] = torch.from_numpy(__import__("numpy").interp(r, nodes, part[0, v, :, c]))
        covariance = torch.diag(seen.noise[0, :, c] ** 2) + seen.shared[0, :, c] @ seen.shared[0, :, c].T
        D, F, G = (part[:, None, None] for part in (d, f, g))
        B, M = b[None, None, :, None], m[None, :, None, None]
        sent = (1 - M) * B * D + (0.04 * (1 - M) + B * M) * F + G
        off = (sent - seen.radiance[0, :, c]).double()
        likelihood = torch.exp(-0.5 * (off @ covariance.double().inverse() * off).sum(-1))
        density = density * likelihood.mean(-1)
        second = second + (likelihood * (b - 0.4) ** 2).mean(-1) / likelihood.mean(-1) / 3
    weight = density * prior
    weight = weight / weight.sum()
    expected = (
        (weight * second).sum(),
        (weight.sum(1) * (r - 0.3) ** 2).sum(),
        (weight.sum(0) * (m - 0.2) ** 2).sum(),
    )
    assert got == pytest.approx([math.sqrt(e) for e in expected], rel=5e-3)


def test_a_mirror_that_may_be_bright_paint_is_uncertain():
    """If the specular part equals the diffuse part in all views, the images do not distinguish them."""
    views = 8
    same = RadianceParts(torch.ones(1, views, R, 3), torch.ones(1, views, R, 3), torch.zeros(1, views, R, 3))
    highlight = torch.linspace(0.2, 4.0, views)[None, :, None, None].expand(1, views, R, 3)
    telling = replace(same, facing=highlight)
    alike = numbers(expected_error(same, sights(torch.full((views,), 0.5), 0.01), material(0.5, 0.5, 0.0)))
    told = numbers(
        expected_error(telling, sights(0.48 + 0.04 * highlight[0, :, 0, 0], 0.01), material(0.48, 0.5, 0.0))
    )
    assert alike[2] > 0.3
    assert told[2] < 0.05


def test_roughness_is_determined_by_views_across_the_lobe():
    nodes = torch.tensor(ROUGHNESS_NODES)
    views = 6
    angle = torch.linspace(0, 1.2, views)[:, None]
    lobe = torch.exp(-angle.square() / (0.05 + nodes.square())) / (0.05 + nodes.square())
    looks = RadianceParts(
        torch.zeros(1, views, R, 3),
        lobe[None, ..., None].expand(1, views, R, 3),
        torch.zeros(1, views, R, 3),
    )
    metal = material(0.8, 0.5, 1.0)
    flat = replace(looks, facing=torch.ones_like(looks.facing))
    moving = numbers(expected_error(looks, sights(0.8 * lobe[:, 4], 0.05), metal))[1]
    still = numbers(expected_error(flat, sights(torch.full((views,), 0.8), 0.05), metal))[1]
    assert moving < 0.06
    assert still == pytest.approx(math.sqrt(1 / 12), rel=0.02)


def test_no_overflow_at_the_ends():
    looks, seen = random_point()
    for noise in (1e-6, 1e6):
        for radiance in (0.0, 1e4):
            extreme = replace(
                seen,
                noise=torch.full_like(seen.noise, noise),
                radiance=torch.full_like(seen.radiance, radiance),
            )
            values = numbers(expected_error(looks, extreme, material()))
            assert all(0 <= v <= 1 + 1e-6 for v in values), (noise, radiance, values)
