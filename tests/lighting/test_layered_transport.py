"""Transport at several roughnesses at once agrees with that of each roughness alone."""

from __future__ import annotations

import torch

from neilfpp_method.fields.environment import EnvironmentLight
from neilfpp_method.fields.lamps import Lamps
from neilfpp_method.fields.light import LightModel
from neilfpp_method.lighting.lamp_transport import from_lamps
from neilfpp_method.lighting.layered_transport import SharedPoints, layers_at, light_layers, texel_layers
from neilfpp_method.lighting.map_transport import from_texels
from neilfpp_method.shading.brdf import GGX
from tests.lighting.surfaces import half_room, points

ROUGHNESSES = (0.3, 0.7)
PIXELS = 40


def shared_points() -> SharedPoints:
    """Each pixel shows a point of its own."""
    observed = points(PIXELS)
    return SharedPoints(observed.position, observed.normal, observed, torch.arange(PIXELS))


def test_the_layers_of_a_map_agree_with_each_roughness_alone():
    environment, shared = EnvironmentLight(48, 1.0), shared_points()
    torch.manual_seed(3)
    draws = [texel_layers(environment, shared, ROUGHNESSES, GGX, None) for _ in range(16)]
    layers = torch.stack([drawn.sources.float() for drawn in draws]).mean(0)
    for number, value in enumerate(ROUGHNESSES):
        roughness = torch.full((PIXELS, 1), value)
        alone = torch.stack(
            [from_texels(environment, shared.observed, roughness, GGX, None).sources for _ in range(16)]
        ).mean(0)
        found = layers_at(layers, torch.full((PIXELS,), number))
        # Summed over the texels: single ones are noisy.
        torch.testing.assert_close(found.sum(-1), alone.sum(-1), rtol=0.05, atol=5e-3)


def test_the_layers_of_a_light_are_those_of_its_map_times_its_radiance_and_those_of_its_lamps():
    environment, lamps, shared = EnvironmentLight(48, 1.0), Lamps(2, 0.06), shared_points()
    environment.show(torch.rand(3, 48, 96) + 0.1)
    lamps.place(torch.tensor([[0.0, 0.0, 2.0]]), torch.full((1, 3), 5.0))
    torch.manual_seed(0)
    found = light_layers(LightModel(environment, lamps), shared, ROUGHNESSES, GGX, half_room)
    torch.manual_seed(0)
    transport = texel_layers(environment, shared, ROUGHNESSES, GGX, half_room)
    radiance = environment.log_radiance.exp().flatten(1).t()
    expected = transport.sources.float() @ radiance + transport.scene
    for number, value in enumerate(ROUGHNESSES):
        roughness = torch.full((PIXELS, 1), value)
        lit = from_lamps(lamps.lit_places, lamps.radius, shared.observed, roughness, GGX, half_room).sources
        sent = lit @ lamps.lit_intensity
        expected[1 + 2 * number : 3 + 2 * number] += sent[1:]
        expected[0] += sent[0] if number == 0 else 0
    torch.testing.assert_close(found.light + found.scene, expected, rtol=1e-4, atol=1e-5)
    torch.testing.assert_close(found.scene, transport.scene)
