"""Transport at several roughnesses at once agrees with that of each roughness alone."""

from __future__ import annotations

import math

import pytest
import torch

from neilfpp_method.fields.environment import EnvironmentLight
from neilfpp_method.fields.lamps import Lamps
from neilfpp_method.fields.light import LightModel
from neilfpp_method.lighting.lamp_transport import from_lamps
from neilfpp_method.lighting.layered_transport import SharedPoints, layers_at, light_layers, texel_layers
from neilfpp_method.lighting.map_transport import from_texels
from neilfpp_method.shading.brdf import GGX, GGX_BURLEY
from tests.lighting.surfaces import half_room, points

ROUGHNESSES = (0.3, 0.7)
PIXELS = 40
lobes = pytest.mark.parametrize("lobe", [GGX, GGX_BURLEY], ids=["one diffuse layer", "one per roughness"])


def shared_points() -> SharedPoints:
    """Each pixel shows a point of its own."""
    observed = points(PIXELS)
    return SharedPoints(observed.position, observed.normal, observed, torch.arange(PIXELS))


@lobes
def test_the_layers_of_a_map_agree_with_each_roughness_alone(lobe):
    environment, shared = EnvironmentLight(48, 1.0), shared_points()
    torch.manual_seed(3)
    draws = [texel_layers(environment, shared, ROUGHNESSES, lobe, None) for _ in range(16)]
    layers = torch.stack([drawn.sources.float() for drawn in draws]).mean(0)
    for number, value in enumerate(ROUGHNESSES):
        roughness = torch.full((PIXELS, 1), value)
        alone = torch.stack(
            [from_texels(environment, shared.observed, roughness, lobe, None).sources for _ in range(16)]
        ).mean(0)
        found = layers_at(layers, torch.full((PIXELS,), number), len(ROUGHNESSES))
        # Summed over the texels: single ones are noisy.
        torch.testing.assert_close(found.sum(-1), alone.sum(-1), rtol=0.05, atol=5e-3)


@lobes
def test_the_layers_of_a_light_agree_with_each_roughness_alone(lobe):
    """Radiance is interpolated between the texels of the map, which differ by a factor of up to ten."""
    environment, lamps, observed = EnvironmentLight(24, 1.0), Lamps(2, 0.06), points(PIXELS)
    torch.manual_seed(0)
    environment.show(torch.rand(3, 24, 48) + 0.1)
    lamps.place(torch.tensor([[0.0, 0.0, 2.0]]), torch.full((1, 3), 5.0))
    light = LightModel(environment, lamps)
    draws = [light_layers(light, observed, ROUGHNESSES, lobe, half_room) for _ in range(64)]
    found = torch.stack([drawn.light + drawn.scene for drawn in draws]).mean(0)
    radiance = environment.log_radiance.exp().flatten(1).t()
    for number, value in enumerate(ROUGHNESSES):
        roughness = torch.full((PIXELS, 1), value)
        alone = [from_texels(environment, observed, roughness, lobe, half_room) for _ in range(16)]
        lit = from_lamps(lamps.lit_places, lamps.radius, observed, roughness, lobe, half_room).sources
        expected = sum(one.sources @ radiance + one.scene for one in alone) / len(alone)
        expected = expected + lit @ lamps.lit_intensity
        layers = layers_at(found, torch.full((PIXELS,), number), len(ROUGHNESSES))
        torch.testing.assert_close(layers, expected, rtol=0.02, atol=0.01)


def test_a_small_sun_has_little_noise():
    """Diffuse light from a sun of one texel. With rays in texels alone its noise is 27 %."""
    torch.manual_seed(1)
    environment = EnvironmentLight(24, 0.1)
    environment.log_radiance[:, 7, 5] = math.log(1000.0)
    light, observed = LightModel(environment, Lamps(1, 0.06)), points(PIXELS)
    draws = [light_layers(light, observed, ROUGHNESSES, GGX, None).light[0, :, 1] for _ in range(24)]
    mean, deviation = torch.stack(draws).mean(0), torch.stack(draws).std(0)
    in_sun = mean > 0.5 * mean.max()
    assert in_sun.sum() > 5
    assert (deviation / mean)[in_sun].mean() < 0.05


def test_a_polished_surface_has_little_noise():
    """The facing part at a roughness of 0.08, under a map that varies by a factor of ten."""
    torch.manual_seed(2)
    environment = EnvironmentLight(48, 1.0)
    environment.show(torch.rand(3, 48, 96) + 0.1)
    light, observed = LightModel(environment, Lamps(1, 0.06)), points(PIXELS)
    draws = [light_layers(light, observed, (0.08,), GGX, None).light[1, :, 1] for _ in range(24)]
    mean, deviation = torch.stack(draws).mean(0), torch.stack(draws).std(0)
    assert (deviation / mean).median() < 0.05
