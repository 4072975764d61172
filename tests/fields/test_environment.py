"""The environment map: look-ups, densities and sampling compared with closed forms."""

from __future__ import annotations

import math

import pytest
import torch
from torch.nn.functional import normalize

from neilfpp_method.fields.direction_map import map_directions, texels_of
from neilfpp_method.fields.environment import EnvironmentLight


def directions(count: int) -> torch.Tensor:
    return normalize(torch.randn(1, count, 3), dim=-1)


def test_it_starts_at_one_radiance_everywhere():
    light = EnvironmentLight(8, 0.25)
    torch.testing.assert_close(
        light.radiance(torch.zeros(1, 3), directions(50)), torch.full((1, 50, 3), 0.25)
    )


def test_radiance_at_a_texel_center_is_that_of_the_texel():
    light = EnvironmentLight(9, 1.0)
    with torch.no_grad():
        light.log_radiance.normal_()
    for row, column in ((4, 0), (4, 17), (2, 5), (7, 11)):
        theta, phi = math.pi * row / 8, 2 * math.pi * (column + 0.5) / 18
        wi = torch.tensor(
            [[[math.sin(phi) * math.sin(theta), math.cos(phi) * math.sin(theta), math.cos(theta)]]]
        )
        expected = light.log_radiance[:, row, column].exp()
        torch.testing.assert_close(light.radiance(torch.zeros(1, 3), wi)[0, 0], expected, rtol=1e-4, atol=0.0)


def test_the_map_is_periodic_in_azimuth():
    light = EnvironmentLight(9, 1.0)
    with torch.no_grad():
        light.log_radiance.normal_()
    phi = torch.tensor([1e-5, 2 * math.pi - 1e-5])
    wi = torch.stack((phi.sin(), phi.cos(), torch.zeros(2)), -1)[None]
    radiance = light.radiance(torch.zeros(1, 3), wi)[0]
    torch.testing.assert_close(radiance[0], radiance[1], rtol=1e-3, atol=0.0)


def test_the_density_follows_the_light():
    light = EnvironmentLight(16, 0.1)
    with torch.no_grad():
        light.log_radiance[:, 5, 9] = math.log(500.0)
    up = torch.tensor([[0.0, 0.0, 1.0]])
    wi = map_directions(16, 32).reshape(1, -1, 3)
    pdf = light.technique(up).pdf(wi)
    brightest = light.radiance(up, wi).mean(-1).argmax()
    assert pdf[0, brightest] > 100 * pdf[wi[..., 2] > 0].median()


@pytest.mark.parametrize("bright", [0.0, 5.0])
def test_samples_follow_the_density(bright):
    """The mean of f/pdf is the integral of f over the hemisphere about z: 2π for 1, 2π/3 for each squared
    coordinate, π for z, 0 for x and y.
    """
    light = EnvironmentLight(12, 1.0)
    with torch.no_grad():
        light.log_radiance[:, 3:5, 7:10] = bright
    torch.manual_seed(0)
    technique = light.technique(torch.tensor([[0.0, 0.0, 1.0]]).expand(5000, 3))
    wi = technique.draw(64, True)
    weight = (wi[..., 2:] > 0) / technique.pdf(wi)[..., None]
    assert weight.mean().item() == pytest.approx(2 * math.pi, rel=0.02)
    squares = (wi.square() * weight).mean((0, 1))
    assert squares.tolist() == pytest.approx([2 * math.pi / 3] * 3, rel=0.03)
    assert (wi * weight).mean((0, 1)).tolist() == pytest.approx([0.0, 0.0, math.pi], abs=0.05)


def test_there_is_one_direction_in_every_texel_and_the_texels_cover_the_sphere():
    light = EnvironmentLight(8, 1.0)
    with torch.no_grad():
        light.log_radiance.copy_(torch.arange(1.0, 129.0).log().view(1, 8, 16).expand(3, -1, -1))
    drawn = light.texel_directions(torch.zeros(5, 3))
    assert drawn.wi.shape == (5, 128, 3)
    assert drawn.solid_angle.sum().item() == pytest.approx(4 * math.pi)
    assert torch.equal(texels_of(drawn.wi, 8, 16), torch.arange(128).expand(5, -1))


# ---------------------------------------------------------------------------------------- maps that are known


def test_a_bright_texel_is_in_the_direction_of_the_layout():
    """Row j ↔ θ = πj/(h − 1) from +z, column i ↔ φ = 2π(i + ½)/w, direction (sin φ sin θ, cos φ sin θ, cos
    θ).
    """
    known = torch.full((3, 9, 12), 0.5)
    known[:, 4, 2] = torch.tensor([40.0, 20.0, 10.0])  # θ = 90°, φ = 75°: mostly +x, and a little +y
    light = EnvironmentLight(16, 1.0)
    light.show(known)
    along = [
        (math.sin(math.radians(75)), math.cos(math.radians(75)), 0.0),
        (-1, 0, 0),
        (0, -1, 0),
        (0, 0, 1),
        (0, 0, -1),
    ]
    radiance = light.radiance(torch.zeros(1, 3), torch.tensor([along], dtype=torch.float32))[0]
    torch.testing.assert_close(radiance[0], torch.tensor([40.0, 20.0, 10.0]), rtol=1e-3, atol=0.0)
    torch.testing.assert_close(radiance[1:], torch.full((4, 3), 0.5))
    torch.testing.assert_close(map_directions(9, 12)[4, 2], torch.tensor(along[0]))


def test_a_known_map_has_the_irradiance_of_its_texels():
    """Bilinear between texels: a lamp of one texel contributes its radiance times its solid angle, π/12 ·
    2π/24.
    """
    known = torch.zeros(3, 13, 24)
    known[:, 6, 10] = 1000.0
    light = EnvironmentLight(8, 1.0)
    light.show(known)
    torch.manual_seed(0)
    # The lamp lies on the equator, so all of it is above the horizon of its own direction.
    normal = map_directions(13, 24)[6, 10].expand(2000, 3)
    technique = light.technique(normal)
    wi = technique.draw(64, True)
    above = (wi * normal[:, None]).sum(-1) > 0
    brought = (light.radiance(normal, wi) * (above / technique.pdf(wi))[..., None]).mean()
    assert brought.item() == pytest.approx(1000 * math.pi / 12 * math.pi / 12, rel=0.02)


def test_a_map_is_restored_from_a_checkpoint_in_its_own_size():
    light, other = EnvironmentLight(8, 1.0), EnvironmentLight(8, 1.0)
    light.show(torch.rand(3, 11, 30) + 0.1)
    other.load_state_dict(light.state_dict())
    wi = directions(40)
    torch.testing.assert_close(
        other.radiance(torch.zeros(1, 3), wi), light.radiance(torch.zeros(1, 3), wi), rtol=0, atol=0
    )
    up = torch.tensor([[0.0, 0.0, 1.0]])
    assert torch.equal(other.technique(up).pdf(wi), light.technique(up).pdf(wi))
    with pytest.raises(RuntimeError):
        other.load_state_dict({"log_radiance": torch.zeros(2, 11, 30)})


@pytest.mark.parametrize("size", [(40, 96), (33, 50), (48, 35), (17, 33)])
def test_a_coarser_map_has_the_means_of_the_finer_one(size):
    light = EnvironmentLight(4, 1.0)
    theta = math.pi * torch.arange(size[0]) / (size[0] - 1)
    phi = 2 * math.pi * (torch.arange(size[1]) + 0.5) / size[1]
    slope = 2 + theta.cos()[:, None] + theta.sin()[:, None] * phi.cos()
    light.show(slope.expand(3, -1, -1))
    coarse = light.at_most(16)
    assert coarse.log_radiance.shape == (3, 16, 32)
    assert coarse.log_radiance.isfinite().all()
    # 2 + y + z changes by at most √2 per radian, and the mean of a texel is shifted by up to half a texel per
    # axis: 0.1 · √2.
    wi = directions(200)
    shown = coarse.radiance(torch.zeros(1, 3), wi)[0, :, 0]
    torch.testing.assert_close(shown, 2 + wi[0, :, 1] + wi[0, :, 2], rtol=0, atol=0.2)
    assert light.at_most(size[0]) is light
