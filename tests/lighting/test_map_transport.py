"""The transport from the texels of a map, against the rendering equation with thousands of samples."""

from __future__ import annotations

import pytest
import torch

from neilfpp_method.fields.direction_map import interpolate, interpolation_weights
from neilfpp_method.fields.environment import EnvironmentLight
from neilfpp_method.lighting.map_transport import from_texels
from neilfpp_method.shading import Sampling, sample_directions, shade
from neilfpp_method.shading.brdf import GGX
from neilfpp_method.structures import Incident, Material
from tests.lighting.surfaces import half_room, points

ROWS, COUNT = 24, 60


def sky() -> EnvironmentLight:
    """A map without smoothness: neighbouring texels differ by a factor of 1.6 on average."""
    environment = EnvironmentLight(ROWS, 1.0)
    generator = torch.Generator().manual_seed(5)
    environment.log_radiance.copy_(0.4 * torch.randn(3, ROWS, 2 * ROWS, generator=generator))
    return environment


@pytest.mark.parametrize("rows", [2, 3, ROWS])
def test_the_four_texels_give_the_interpolated_value(rows):
    generator = torch.Generator().manual_seed(0)
    values = torch.rand(3, rows, 2 * rows, generator=generator)
    wi = torch.nn.functional.normalize(torch.randn(50, 8, 3, generator=generator), dim=-1)
    wi[0] = torch.tensor([0.0, 0.0, 1.0])
    wi[1] = torch.tensor([0.0, 0.0, -1.0])
    texel, weight = interpolation_weights(wi, rows, 2 * rows)
    found = (values.flatten(1)[:, texel] * weight).sum(1).permute(1, 2, 0)
    torch.testing.assert_close(found, interpolate(values, wi), rtol=1e-4, atol=1e-4)
    torch.testing.assert_close(weight.sum(0), torch.ones(50, 8))


@pytest.mark.parametrize("roughness", [0.1, 0.14, 0.2, 0.5])
def test_what_a_mirror_like_metal_reflects_has_little_noise(roughness):
    """A lobe of roughness 0.14 is narrower than a texel (7.8°), so most rays in texels miss it."""
    torch.manual_seed(0)
    environment, seen = sky(), points(COUNT)
    of = Material(torch.full((COUNT, 3), 0.8), torch.full((COUNT, 1), roughness), torch.ones(COUNT, 1))
    drawn = sample_directions(Sampling("mis", 16_384, GGX, True), seen.normal, seen.wo, of)
    radiance = environment.radiance(seen.position, drawn.wi)
    radiance = torch.where(drawn.wi[..., 2:] < 0, 0.7, radiance)
    expected = shade(of, seen.normal, seen.wo, Incident.of(drawn, radiance), GGX).color

    texels = environment.log_radiance.exp().flatten(1).t()
    several = torch.stack(
        [from_texels(environment, seen, of.roughness, GGX, half_room).outgoing(of, texels) for _ in range(16)]
    )
    assert (several / expected).std(0).mean() < 0.06
    torch.testing.assert_close((several.mean(0) / expected).mean(), torch.tensor(1.0), rtol=0.005, atol=0.0)
    torch.testing.assert_close(several.mean(0), expected, rtol=0.1, atol=0.0)
