"""The factorised light field: its start, the sum written out, shared directions, and a light that it can hold exactly."""

from __future__ import annotations

import dataclasses
import math

import pytest
import torch

from neilfpp_method.config import IncidentLightConfig
from neilfpp_method.fields.direction_map import interpolate, map_directions
from neilfpp_method.fields.environment import EnvironmentLight
from neilfpp_method.fields.factorised_light import FactorisedLightField
from neilfpp_method.fields.free_light import make_incident_light
from neilfpp_method.fields.incident_light import IncidentLightField

CONFIG = IncidentLightConfig(network="factorised", rank=8, width=32, environment_height=8)


def rays(points: int = 5, directions: int = 7) -> tuple[torch.Tensor, torch.Tensor]:
    torch.manual_seed(1)
    return torch.rand(points, 3) - 0.5, torch.nn.functional.normalize(torch.randn(points, directions, 3), dim=-1)


def field_of(config: IncidentLightConfig = CONFIG, base: float = 10.0, start: float = 1.0) -> FactorisedLightField:
    torch.manual_seed(0)
    return FactorisedLightField(config, base, start)


@pytest.mark.parametrize("base", [math.e, 10.0])
@pytest.mark.parametrize("rank", [8, 32])
def test_starts_near_the_initial_radiance(base, rank):
    config = dataclasses.replace(CONFIG, rank=rank, width=128, environment_height=32)
    light = field_of(config, base, start=0.7).radiance(*rays(50, 20))
    assert light.shape == (50, 20, 3)
    assert light.min() > 0
    assert light.mean().item() == pytest.approx(0.7, rel=0.25)
    assert light.std() < 0.35


def test_is_the_exponential_of_a_sum_of_products():
    """⟨f, g⟩ for one point, direction and channel at a time, at texels, where nothing is interpolated."""
    field = field_of(start=2.0)
    x, _ = rays(3)
    row, column, height = 3, 5, 8
    theta, phi = math.pi * row / (height - 1), 2 * math.pi * (column + 0.5) / (2 * height)
    wi = torch.tensor([[math.sin(phi) * math.sin(theta), math.cos(phi) * math.sin(theta), math.cos(theta)]])
    light = field.radiance(x, wi)
    texel = field.direction_map[:, row, column]
    for n in range(3):
        factors = field.position_part(field.position(x[n : n + 1]))[0]
        for c in range(3):
            exponent = sum(factors[c * 8 + k] * texel[k] for k in range(8))
            assert light[n, 0, c].item() == pytest.approx(2 * 10 ** exponent.item(), rel=1e-4)


@pytest.mark.parametrize("shape", [(1, 7, 3), (7, 3)])
def test_directions_can_be_shared_between_points(shape):
    field, (x, wi) = field_of(), rays()
    torch.testing.assert_close(field.radiance(x, wi[0].view(shape)), field.radiance(x, wi[:1].expand_as(wi)))


def test_an_environment_is_a_light_of_rank_one():
    """With f = 1 the field is, at the texels, the environment map whose log radiance is g, grey."""
    field = field_of(dataclasses.replace(CONFIG, rank=1), base=math.e)
    with torch.no_grad():
        for layer in field.position_part.layers:
            layer.weight.zero_()
        field.position_part.layers[-1].bias.fill_(1.0)
    environment = EnvironmentLight(8, 1.0)
    with torch.no_grad():
        environment.log_radiance.copy_(field.direction_map.expand(3, -1, -1))
    x, wi = torch.rand(5, 3), map_directions(8, 16).reshape(1, -1, 3)
    expected = environment.radiance(x, wi).expand(5, -1, -1)
    torch.testing.assert_close(field.radiance(x, wi), expected, rtol=1e-4, atol=1e-4)


def test_every_parameter_learns():
    field = field_of()
    field.radiance(*rays(20, 50)).log().square().sum().backward()
    for name, parameter in field.named_parameters():
        assert parameter.grad.abs().sum() > 0, name


def test_monochrome_light_is_grey():
    light = field_of(dataclasses.replace(CONFIG, monochrome=True)).radiance(*rays())
    assert light.shape == (5, 7, 3)
    assert (light == light[..., :1]).all()


def test_far_exponents_stay_finite():
    field = field_of()
    with torch.no_grad():
        field.direction_map.mul_(1e6)
    light = field.radiance(*rays())
    assert light.isfinite().all()
    assert light.min() > 0
    light.log().sum().backward()
    assert all(p.grad.isfinite().all() for p in field.parameters())


def test_no_points_are_no_trouble():
    assert field_of().radiance(torch.zeros(0, 3), torch.zeros(0, 4, 3)).shape == (0, 4, 3)
    assert field_of().radiance(torch.zeros(0, 3), torch.zeros(4, 3)).shape == (0, 4, 3)


def test_the_settings_name_the_network():
    assert isinstance(make_incident_light(CONFIG, 10.0, 1.0), FactorisedLightField)
    assert isinstance(make_incident_light(IncidentLightConfig(), 10.0, 1.0), IncidentLightField)


# -------------------------------------------------------------------------------------------------------- direction maps


def test_a_map_closes_in_azimuth_and_holds_at_the_poles():
    values = torch.rand(2, 8, 16)
    angle = 1e-4
    either_side = torch.tensor([[[s * math.sin(angle), math.cos(angle), 0.0] for s in (-1.0, 1.0)]])
    torch.testing.assert_close(*interpolate(values, either_side)[0], atol=2e-3, rtol=0)
    poles = interpolate(values, torch.tensor([[[0.0, 0.0, 1.0], [0.0, 0.0, -1.0]]]))
    assert poles.isfinite().all()
