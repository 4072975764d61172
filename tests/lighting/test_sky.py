"""Direct observations of the light: their mean, their weight, and their influence on a fit."""

from __future__ import annotations

import dataclasses
import math

import pytest
import torch

from neilfpp_method.fields.direction_map import map_directions
from neilfpp_method.fields.environment import EnvironmentLight
from neilfpp_method.lighting.fit import MapAndLamps, fit_light
from neilfpp_method.lighting.map_transport import from_texels
from neilfpp_method.lighting.objective import Objective, Target
from neilfpp_method.lighting.sky import HALF_WEIGHT_SPREAD, SkySightings
from neilfpp_method.shading.color import linear_to_srgb
from tests.lighting.surfaces import looks, material, points

HEIGHT = 12


def gradient(wi: torch.Tensor) -> torch.Tensor:
    """A sky that is bright above and bluish below, and varies smoothly."""
    height = wi[..., 2:]
    return (0.3 + 0.2 * height) * torch.tensor([1.0, 1.1, 1.3]) - 0.1 * height * torch.tensor([0.0, 0.0, 1.0])


@pytest.mark.parametrize("response", ["linear", "srgb"])
def test_texels_have_the_mean_of_their_pixels(response):
    sky, wi = SkySightings(HEIGHT, response), looks(20_000, below=0.2)
    shown = gradient(wi)
    beyond = torch.rand(len(wi), generator=torch.Generator().manual_seed(1)) < 0.5
    sky.remember(wi[beyond], shown[beyond] if response == "linear" else linear_to_srgb(shown[beyond]))
    known, middle = sky.known(), map_directions(HEIGHT, 2 * HEIGHT)
    inside = (middle[..., 2] < 0.0) & (middle[..., 2] > -0.95)
    assert (known.weight[inside] > 0.8).all()
    assert (known.weight[middle[..., 2] > 0.5] == 0).all()
    expected = gradient(middle)[inside].log()
    torch.testing.assert_close(known.log_radiance.permute(1, 2, 0)[inside], expected, atol=0.05, rtol=0.0)


def test_near_objects_lower_the_weight():
    """Half of the pixels of every direction show a wall, which is in different directions from different
    cameras.
    """
    sky, wi = SkySightings(HEIGHT, "linear"), looks(20_000)
    color = torch.where(torch.arange(len(wi))[:, None] % 2 == 0, 0.1, 1.0).expand(-1, 3)
    sky.remember(wi, color)
    expected = 1 / (1 + (0.45 / 0.55) ** 2 / HALF_WEIGHT_SPREAD**2)  # 0.12
    assert sky.known().weight[sky.pixels > 30].mean() == pytest.approx(expected, rel=0.15)


@pytest.mark.parametrize("white", [1.0, linear_to_srgb(torch.tensor(1.0)).item(), 253 / 255])
def test_a_clipped_pixel_makes_its_texel_unseen(white):
    """Also in a reduced image, whose pixels are averaged and encoded again, with rounding below 1."""
    sky, wi = SkySightings(HEIGHT, "srgb"), looks(5000)
    color = torch.full((len(wi), 3), 0.5)
    color[wi[:, 2] > 0.5, 0] = white
    sky.remember(wi, color)
    up = map_directions(HEIGHT, 2 * HEIGHT)[..., 2]
    weight = sky.known().weight
    assert (weight[up > 0.7] == 0).all()
    assert (weight[up.abs() < 0.2] > 0.5).all()


def test_without_observations_all_weights_are_zero():
    sky = SkySightings(HEIGHT, "linear")
    sky.remember(looks(100)[:0], torch.zeros(0, 3))
    known = sky.known()
    assert not known.weight.any()
    assert known.log_radiance.isfinite().all()
    assert known.misfit(torch.zeros(3, HEIGHT, 2 * HEIGHT)) == 0


def test_a_fit_keeps_observed_texels_and_estimates_the_others():
    """Cameras observe the lower half of the sky and the horizon; surfaces determine the upper part."""
    torch.manual_seed(0)
    seen, of = points(256), material(256)
    directions = map_directions(HEIGHT, 2 * HEIGHT)
    truth = gradient(directions).permute(2, 0, 1)
    environment = EnvironmentLight(HEIGHT, 1.0)
    carried = from_texels(environment, seen, of.roughness, None, None)
    image = carried.outgoing(of, truth.flatten(1).t())
    sky, wi = SkySightings(HEIGHT, "linear"), looks(20_000, below=0.1)
    sky.remember(wi, gradient(wi))
    wrong = dataclasses.replace(of, base_color=0.7 * of.base_color)

    def error(known: SkySightings | None) -> torch.Tensor:
        unit = image.median().item()
        seen_sky = known and known.known()
        log_scale = None if seen_sky and seen_sky.fixes_scale else 0.0
        objective = Objective("linear", unit, steps=300, sky=seen_sky, log_scale=log_scale)
        start = MapAndLamps(torch.full((3, HEIGHT, 2 * HEIGHT), math.log(0.5)), torch.zeros(0, 3))
        found = fit_light(start, carried, Target(seen.position, wrong, image), objective)
        return (found.log_radiance - truth.log()).abs().mean(0)

    below = directions[..., 2] < -0.1
    assert error(sky)[below].mean() < 0.05
    assert error(None)[below].mean() > 0.2
