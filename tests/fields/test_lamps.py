"""Near lamps compared with the closed forms of small spheres."""

from __future__ import annotations

import math

import pytest
import torch
from torch.nn.functional import normalize

from neilfpp_method.fields.lamps import Lamps
from neilfpp_method.shading.rendering_equation import shade
from neilfpp_method.structures import Incident, Material


def lamps() -> Lamps:
    both = Lamps(3, radius=0.05)
    both.place(
        torch.tensor([[0.0, 0.0, 1.0], [0.6, 0.0, 0.8]]), torch.tensor([[0.2, 0.2, 0.2], [0.3, 0.6, 0.9]])
    )
    return both


def test_at_most_the_maximum_number_of_lamps_is_lit():
    few = Lamps(1, radius=0.05)
    few.place(
        torch.tensor([[0.0, 0.0, 1.0], [0.6, 0.0, 0.8]]), torch.tensor([[0.2, 0.2, 0.2], [0.3, 0.6, 0.9]])
    )
    assert few.count == 1
    torch.testing.assert_close(few.position, torch.tensor([[0.0, 0.0, 1.0]]))


def test_a_lambertian_surface_shows_cosine_and_inverse_square():
    """L_o = Σ b/π I cos θ / d²: both lamps are 1 away, one overhead and one at cos θ = 0.8."""
    light = lamps()
    x, up = torch.zeros(1, 3), torch.tensor([[0.0, 0.0, 1.0]])
    rays = light.rays_from(x)
    material = Material(torch.tensor([[0.5, 0.5, 0.5]]), torch.ones(1, 1), torch.zeros(1, 1))
    radiance = light.arriving(rays)
    color = shade(material, up, up, Incident.of(rays.samples(), radiance), None).color[0]
    expected = 0.5 / math.pi * (0.8 * torch.tensor([0.3, 0.6, 0.9]) + 0.2)
    torch.testing.assert_close(color, expected)


def test_lamps_hit_by_directions_give_the_same_irradiance_as_lamp_rays():
    """Integrated over the hemisphere, the discs of the lamps contribute Σ I cos θ / d²."""
    light = lamps()
    torch.manual_seed(0)
    wi = normalize(torch.randn(1, 2_000_000, 3), dim=-1)
    wi[..., 2] = wi[..., 2].abs()
    seen = light.radiance_along(torch.zeros(1, 3), wi, torch.full((1, 2_000_000), math.inf))
    irradiance = 2 * math.pi * (seen * wi[..., 2:]).mean(1)[0]
    torch.testing.assert_close(irradiance, 0.8 * torch.tensor([0.3, 0.6, 0.9]) + 0.2, rtol=0.05, atol=0.0)


def test_a_lamp_with_an_axis_emits_by_the_cosine_and_not_backwards():
    """By both methods, at 0°, 60° and 120° from the axis of a lamp at the origin."""
    light = Lamps(1, radius=0.05)
    light.place(torch.zeros(1, 3), torch.full((1, 3), 0.6), torch.tensor([[0.0, 0.0, 1.0]]))
    angle = torch.tensor([0.0, math.pi / 3, 2 * math.pi / 3])
    x = 2 * torch.stack((angle.sin(), torch.zeros(3), angle.cos()), -1)
    full = 0.6 / (math.pi * 0.05**2)
    expected = full * torch.tensor([1.0, 0.5, 0.0])[:, None].expand(3, 3)
    torch.testing.assert_close(light.arriving(light.rays_from(x))[:, 0], expected, atol=1e-4, rtol=1e-5)
    infinite = torch.full((3, 1), math.inf)
    torch.testing.assert_close(
        light.radiance_along(x, -x[:, None] / 2, infinite)[:, 0], expected, atol=1e-4, rtol=1e-5
    )


def test_a_closer_surface_occludes_a_lamp():
    light = lamps()
    up = torch.tensor([[[0.0, 0.0, 1.0]]])
    x = torch.zeros(1, 3)
    assert light.radiance_along(x, up, torch.tensor([[0.5]])).sum() == 0
    assert light.radiance_along(x, up, torch.tensor([[2.0]])).sum() > 0
    assert light.radiance_along(x, -up, torch.tensor([[math.inf]])).sum() == 0


def test_a_point_inside_a_lamp_gets_finite_light():
    light = lamps()
    rays = light.rays_from(light.position[:2])
    assert rays.wi.isfinite().all()
    assert rays.solid_angle.max().item() == pytest.approx(math.pi / 4)


def test_a_checkpoint_has_the_number_of_lit_lamps():
    before = lamps()
    before.axis[0] = torch.tensor([0.0, 0.0, -1.0])
    again = Lamps(3, radius=0.05)
    again.load_state_dict(before.state_dict())
    assert again.count == 2
    assert torch.equal(again.axis, before.axis)
    assert torch.equal(again.radiance(), lamps().radiance())
