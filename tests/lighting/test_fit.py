"""The fit of an environment map, compared with closed forms, the Monte-Carlo estimator, and known maps."""

from __future__ import annotations

import math

import pytest
import torch
from torch.nn.functional import normalize

from neilfpp_method.fields.environment import EnvironmentLight
from neilfpp_method.lighting.fit import Evidence, MapAndLamps, fit_light
from neilfpp_method.lighting.map_transport import from_texels
from neilfpp_method.lighting.objective import (
    Objective,
    Target,
    nearest_points,
    tint,
    total_variation,
    unevenness,
    white_balance,
)
from neilfpp_method.lighting.transport import Transport
from neilfpp_method.shading.brdf import GGX
from neilfpp_method.shading.rendering_equation import shade
from neilfpp_method.shading.sampling import Sampling, sample_directions
from neilfpp_method.structures import Incident, Material, Observed
from tests.lighting.surfaces import half_room, material, patches, points


def fit(
    environment: EnvironmentLight,
    carried: Transport,
    target: Target,
    unit: float,
    steps: int,
    base_color_known: bool = False,
) -> None:
    """Set a map by a fit without lamps."""
    start = MapAndLamps(environment.log_radiance, torch.zeros(0, 3))
    objective = Objective("linear", unit, steps, base_color_known)
    found = fit_light(start, carried, target, objective)
    environment.log_radiance.copy_(found.log_radiance)


def test_a_lambertian_surface_in_a_white_furnace_has_its_base_colour():
    torch.manual_seed(0)
    seen, of = points(16), material(16)
    carried = from_texels(EnvironmentLight(48, 1.0), seen, of.roughness, None, None)
    white = torch.ones(carried.sources.shape[-1], 3)
    torch.testing.assert_close(carried.outgoing(of, white), of.base_color, rtol=0.01, atol=0.0)


def test_transport_agrees_with_the_estimator_under_a_map_and_a_wall():
    torch.manual_seed(0)
    seen, of = points(24), material(24)
    environment = EnvironmentLight(48, 1.0)
    rows = torch.linspace(0, math.pi, 48)[:, None].expand(48, 96)
    environment.log_radiance.copy_(torch.stack((rows.cos(), 0.5 * rows.sin(), -rows.cos())))
    several = [from_texels(environment, seen, of.roughness, GGX, half_room) for _ in range(4)]
    # The texels are read at their centres; this map varies little between texels.
    radiance = environment.log_radiance.exp().flatten(1).t()
    carried = sum(one.outgoing(of, radiance) for one in several) / len(several)

    drawn = sample_directions(Sampling("mis", 16_384, GGX, stochastic=True), seen.normal, seen.wo, of)
    arriving = environment.radiance(seen.position, drawn.wi)
    arriving = torch.where(drawn.wi[..., 2:] < 0, 0.7, arriving)
    expected = shade(of, seen.normal, seen.wo, Incident.of(drawn, arriving), GGX).color
    torch.testing.assert_close(carried, expected, rtol=0.06, atol=0.02)


def test_gradients_of_transport_in_sources_and_strength():
    torch.manual_seed(0)
    of = Material(*(value.double() for value in (torch.rand(4, 3), torch.rand(4, 1), torch.rand(4, 1))))
    sources, scene, strength = (
        torch.rand(*shape, dtype=torch.float64) for shape in ((3, 4, 5), (3, 4, 3), (5, 3))
    )
    unknowns = (sources.requires_grad_(), strength.requires_grad_())
    torch.autograd.gradcheck(lambda a, b: Transport(a, scene).outgoing(of, b), unknowns)


def lamp(height: int) -> EnvironmentLight:
    """A dim sky with one lamp of 40 at row 8, column 20 of a map of 24 rows, and its neighbours at 5."""
    environment = EnvironmentLight(height, 0.3)
    environment.log_radiance[:, 7:10, 19:22] = math.log(5.0)
    environment.log_radiance[:, 8, 20] = math.log(40.0)
    return environment


@pytest.mark.parametrize("tint", [1.0, 0.6])
@pytest.mark.parametrize(
    ("made_of", "known", "steps"),
    [("speckles", True, [200]), ("patches", False, 4 * [100]), ("speckles", False, 4 * [100])],
    ids=["known", "even", "uneven"],
)
def test_a_lamp_is_found_with_its_position_and_brightness(tint, made_of, known, steps):
    """Also if the base colour is wrong by one factor, which light and base colour share, and if fits follow
    each other and every point has its own colour.
    """
    torch.manual_seed(0)
    seen = points(600)
    of = material(600) if made_of == "speckles" else patches(seen.position)
    true = lamp(24)
    radiance = true.log_radiance.exp().flatten(1).t()
    image = from_texels(true, seen, of.roughness, GGX, None).outgoing(of, radiance)

    found = EnvironmentLight(24, 1.0)
    carried = from_texels(found, seen, of.roughness, GGX, None)
    guess = Material(of.base_color * tint, of.roughness, of.metallic)
    for number in steps:
        fit(found, carried, Target(seen.position, guess, image), image.median().item(), number, known)

    green = found.log_radiance[1]
    row, column = divmod(int(green.argmax()), 48)
    assert abs(row - 8) <= 1
    assert abs(column - 20) <= 1
    # The power around the lamp, over which one texel may share with the next, in units of the sky far from
    # it.
    sky = green[:, 30:].median()
    power = (green[6:11, 18:23] - sky).exp().sum().item()
    assert power == pytest.approx((true.log_radiance[1, 6:11, 18:23].exp() / 0.3).sum().item(), rel=0.25)
    assert (green[:, 30:] - sky).abs().mean() < 0.3


def test_texels_without_observations_follow_their_neighbours():
    torch.manual_seed(0)
    seen = points(300)
    up = normalize(seen.normal * torch.tensor([0.2, 0.2, 0.0]) + torch.tensor([0.0, 0.0, 1.0]), dim=-1)
    seen = Observed(seen.position, up, up, seen.pixel)
    of = Material(torch.full((300, 3), 0.5), torch.full((300, 1), 0.9), torch.zeros(300, 1))
    true = EnvironmentLight(16, 2.0)
    image = from_texels(true, seen, of.roughness, GGX, None).outgoing(of, torch.full((512, 3), 2.0))
    found = EnvironmentLight(16, 0.5)
    carried = from_texels(found, seen, of.roughness, GGX, None)
    fit(found, carried, Target(seen.position, of, image), 1.0, steps=300)
    assert found.log_radiance[:, -2:].exp().mean().item() == pytest.approx(2.0, rel=0.35)


def test_texels_that_few_points_see_do_not_become_a_sun():
    """All points are under an even sky, but twelve of three hundred are mirrors that face down in one
    direction, and are brighter than the sky.
    """
    torch.manual_seed(0)
    seen = points(300)
    up = normalize(seen.normal * torch.tensor([0.2, 0.2, 0.0]) + torch.tensor([0.0, 0.0, 1.0]), dim=-1)
    up[:12] = torch.tensor([0.6, 0.0, -0.8])
    seen = Observed(seen.position, up, up, seen.pixel)
    mirror = torch.zeros(300, 1)
    mirror[:12] = 1.0
    of = Material(torch.full((300, 3), 0.5), 0.9 - 0.7 * mirror, mirror)
    found = EnvironmentLight(32, 2.0)
    carried = from_texels(found, seen, of.roughness, GGX, None)
    image = carried.outgoing(of, torch.full((2048, 3), 2.0))
    image[:12] *= 5
    fit(found, carried, Target(seen.position, of, image), 1.0, steps=100)
    assert found.log_radiance.exp().max() < 4.0


@pytest.mark.parametrize(
    ("gain", "deviation", "points", "new", "chosen"),
    [
        (0.05, 0.01, 200, True, True),
        (0.015, 0.01, 200, False, True),  # not significant: an existing choice is kept, a new one is not made
        (0.005, 0.001, 200, False, False),  # significant, but below the threshold
        (-0.02, 0.02, 200, False, True),
        (-0.02, 0.01, 200, False, False),
        (0.05, 0.01, 5, False, False),  # hardly any points
    ],
)
def test_without_significance_the_choice_is_kept(gain, deviation, points, new, chosen):
    spoken = Evidence(gain, deviation, points)
    assert (spoken.favours(chosen=False), spoken.favours(chosen=True)) == (new, chosen)


def test_unevenness_is_the_mean_step_of_log_base_colour():
    """Points along a line, each with two neighbours on either side: a step of ln 2 lies between 6 of 40
    pairs.
    """
    position = torch.arange(10.0)[:, None] * torch.tensor([1.0, 0.0, 0.0])
    nearest = nearest_points(position)
    assert sorted(nearest[5].tolist()) == [3, 4, 6, 7]
    step = torch.where(position[:, :1] < 4.5, 0.3, 0.6).expand(-1, 3)
    assert unevenness(step, nearest).item() == pytest.approx(math.log(2) * 6 / 40, abs=0.01)
    assert unevenness(0.5 * step, nearest).item() == pytest.approx(unevenness(step, nearest).item(), rel=1e-5)
    assert unevenness(step[:1], nearest_points(position[:1])) == 0


def test_total_variation_counts_every_step_once_and_wraps_in_azimuth():
    """One column of 1 in a map of 0: each of its four rows of 8 texels has two steps."""
    values = torch.zeros(1, 4, 8)
    values[0, :, 7] = 1.0
    assert total_variation(values).item() == pytest.approx(
        2 * 4 / 32, abs=0.02
    )  # the rounding near 0 adds 0.01 a step


def test_a_map_without_a_finite_solution_is_unchanged():
    seen, of = points(8), material(8)
    environment = EnvironmentLight(8, 0.5)
    before = environment.log_radiance.clone()
    carried = from_texels(environment, seen, of.roughness, GGX, None)
    broken = torch.full((8, 3), math.inf)
    fit(environment, carried, Target(seen.position, of, broken), 1.0, steps=3)
    assert torch.equal(environment.log_radiance, before)


ORANGE_AND_BLUE = torch.tensor([[1.6, 1.0, 0.4], [0.4, 1.0, 1.6]])


def test_coloured_texels_that_add_up_to_white_are_not_balanced():
    all_light = ORANGE_AND_BLUE.sum(0)
    assert tint(all_light) < 1e-12
    assert white_balance(ORANGE_AND_BLUE, all_light, "srgb") > 0.02
    grey = ORANGE_AND_BLUE.mean(-1, keepdim=True).expand(2, 3)
    assert white_balance(grey, grey.sum(0), "srgb") < 1e-12
    # Linear radiance was not balanced by a camera.
    assert white_balance(ORANGE_AND_BLUE, all_light, "linear") == 0


def test_white_balance_does_not_depend_on_the_unit_and_counts_texels_by_their_light():
    all_light = ORANGE_AND_BLUE.sum(0)
    whole = white_balance(ORANGE_AND_BLUE, all_light, "srgb")
    torch.testing.assert_close(white_balance(1e4 * ORANGE_AND_BLUE, 1e4 * all_light, "srgb"), whole)
    # The same light from four texels, and beside as much white light.
    torch.testing.assert_close(white_balance(ORANGE_AND_BLUE.repeat(2, 1) / 2, all_light, "srgb"), whole)
    torch.testing.assert_close(white_balance(ORANGE_AND_BLUE, 2 * all_light, "srgb"), whole / 2)


def test_gradient_of_white_balance():
    torch.manual_seed(0)
    contribution = (torch.rand(5, 3, dtype=torch.float64) + 0.05).requires_grad_()
    torch.autograd.gradcheck(lambda c: white_balance(c, c.sum(0), "srgb"), contribution)
    dark = torch.zeros(2, 3, requires_grad=True)
    white_balance(dark, torch.ones(3), "srgb").backward()
    assert dark.grad.isfinite().all()
