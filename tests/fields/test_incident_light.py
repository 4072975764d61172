"""L: its initial value, the layers that position and direction enter, and the exponential."""

from __future__ import annotations

import pytest
import torch

from neilfpp_method.fields.incident_light import IncidentLightField
from neilfpp_method.settings.presets import free_light, preset
from neilfpp_method.settings.types import FreeLightConfig, FrequencyConfig

CONFIGS = {name: preset(name) for name in ("paper-mlp", "paper-ngp")} | {"fast": free_light(preset("fast"))}
WAVES = FrequencyConfig()


def rays(points: int = 5, directions: int = 7) -> tuple[torch.Tensor, torch.Tensor]:
    torch.manual_seed(1)
    return torch.rand(points, 3) - 0.5, torch.nn.functional.normalize(
        torch.randn(points, directions, 3), dim=-1
    )


@pytest.mark.parametrize("name", ["paper-mlp", "paper-ngp", "fast"])
@pytest.mark.parametrize("base", [2.718281828, 10.0])
def test_starts_near_the_initial_radiance(name, base):
    torch.manual_seed(0)
    light = IncidentLightField(
        CONFIGS[name].light, CONFIGS[name].encoding, base, initial_radiance=0.7
    ).radiance(*rays(50, 20))
    assert light.shape == (50, 20, 3)
    assert light.min() > 0
    assert light.mean().item() == pytest.approx(0.7, rel=0.25)
    assert light.std() < 0.35


def test_position_and_direction_enter_the_layers_of_the_paper():
    """Compared with the network written as one chain of layers over concatenated inputs."""
    torch.manual_seed(0)
    field = IncidentLightField(
        FreeLightConfig(layers=6, width=16), WAVES, base=10.0, initial_radiance=2.0
    ).double()
    x, wi = (t.double() for t in rays())
    direction = field.direction(wi)
    hidden = direction
    for layer in field.direction_part.layers[:-1]:  # layers 0, 1, 2 see the direction alone
        hidden = torch.sin(30 * layer(hidden))
    joined = torch.cat((hidden, direction, x[:, None].expand_as(wi)), -1)  # layer 3 sees both
    middle = field.direction_part.layers[-1]
    weight = torch.cat((middle.weight, field.position_part.weight), 1)
    hidden = torch.sin(30 * (joined @ weight.T + middle.bias))
    for layer in field.tail.layers[:-1]:  # layers 4, 5
        hidden = torch.sin(30 * layer(hidden))
    expected = 2 * 10 ** field.tail.layers[-1](hidden)
    assert (len(field.direction_part.layers) - 1, len(field.tail.layers) - 1) == (3, 2)
    torch.testing.assert_close(field.radiance(x, wi), expected)


def test_shared_directions_give_the_same_radiance():
    """The part of the network that depends only on the direction is then evaluated once per direction, not
    once per pair.
    """
    field = IncidentLightField(CONFIGS["fast"].light, CONFIGS["fast"].encoding, 10.0, 1.0)
    x, wi = rays()
    every = wi[:1].expand_as(wi)
    seen = []
    field.direction_part.register_forward_hook(
        lambda module, inputs, output: seen.append(output[..., 0].numel())
    )
    torch.testing.assert_close(field.radiance(x, wi[:1]), field.radiance(x, every))
    assert seen == [7, 35]


def test_monochrome_light_is_gray():
    light = IncidentLightField(FreeLightConfig(monochrome=True), WAVES, 2.718281828, 1.0).radiance(*rays())
    assert light.shape == (5, 7, 3)
    assert (light == light[..., :1]).all()


@pytest.mark.parametrize("output", [-1e4, 1e4])
def test_an_output_beyond_the_limit_stays_finite_and_can_return(output):
    field = IncidentLightField(CONFIGS["fast"].light, CONFIGS["fast"].encoding, 10.0, 1.0)
    with torch.no_grad():
        field.tail.layers[-1].bias.fill_(output)
    light = field.radiance(*rays())
    torch.testing.assert_close(light.log(), torch.full_like(light, 20.0 if output > 0 else -20.0))
    light.log().sum().backward()
    assert (field.tail.layers[-1].bias.grad > 0).all()
