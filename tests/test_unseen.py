"""Places that no camera looks at, against a room whose light is known in closed form."""

from __future__ import annotations

import dataclasses

import pytest
import torch
from torch.nn.functional import normalize

from neilfpp_method import unseen
from neilfpp_method.errors import UserError
from neilfpp_method.facts import SceneFacts
from neilfpp_method.model import NeilfModel
from neilfpp_method.structures import RayBatch, SurfaceHits
from neilfpp_method.unseen import SeenPlaces
from tests.scenes import sphere_model, tiny_config

FLOOR, GUESS = 0.8, 5.0
CEILING = 0.5


class Plates:
    """A host: an endless floor at z = 0, whose radiance is known, under an endless ceiling, of which R has a wrong idea."""

    def render(self, rays: RayBatch) -> SurfaceHits:
        up = rays.directions[:, 2] > 0
        height = torch.where(up, CEILING, 0.0)
        depth = (height - rays.origins[:, 2]) / rays.directions[:, 2]
        ones = torch.ones(len(rays))
        color = torch.where(up, GUESS, FLOOR)[:, None].expand(-1, 3)
        normal = torch.stack((torch.zeros_like(depth), torch.zeros_like(depth), torch.where(up, -1.0, 1.0)), -1)
        return SurfaceHits(color, rays.origins + depth[:, None] * rays.directions, normal, ones, ones)


def between_plates(mode: str = "shaded") -> NeilfModel:
    config = tiny_config()
    config = dataclasses.replace(
        config,
        light=dataclasses.replace(config.light, kind="distant", environment_height=8),
        inter_reflection=dataclasses.replace(config.inter_reflection, mode="hard", unseen=mode, offset=1e-4),
        shading=dataclasses.replace(config.shading, specular=False),
    )
    torch.manual_seed(0)
    return NeilfModel(Plates(), config, SceneFacts("linear", 0.2, 3.0, "constant"))


def look_at_the_floor(model: NeilfModel) -> None:
    across = torch.linspace(-1.7, 1.7, 140)
    floor = torch.cartesian_prod(across, across, torch.zeros(1))
    for _ in range(unseen.LIFE // len(floor) + 1):
        model.seen_places.remember(floor)


def from_the_floor(model: NeilfModel) -> torch.Tensor:
    """What arrives at a point of the floor from steep directions."""
    torch.manual_seed(1)
    up = normalize(torch.randn(1, 64, 3) * 0.2 + torch.tensor([0.0, 0.0, 1.0]), dim=-1)
    return model.incident_light(torch.tensor([[0.1, 0.2, 0.0]]), up)


def test_what_no_camera_sees_sends_what_its_material_makes_of_its_light(monkeypatch):
    monkeypatch.setattr(unseen, "MOST", 1.0)
    model = between_plates()
    look_at_the_floor(model)
    # All light that the ceiling gets is the floor's: π · FLOOR, of which a Lambertian surface sends base colour / π.
    expected = torch.full((1, 64, 3), FLOOR * model.config.brdf.initial_base_color)
    arriving = from_the_floor(model)
    torch.testing.assert_close(arriving, expected, rtol=0.1, atol=0.0)
    arriving.sum().backward()
    assert any(p.grad is not None and p.grad.abs().max() > 0 for p in model.brdf.parameters())


def test_what_a_camera_sees_sends_what_it_sees():
    model = between_plates()
    look_at_the_floor(model)
    down = -normalize(torch.rand(1, 16, 3) + 0.1, dim=-1)
    arriving = model.incident_light(torch.tensor([[0.0, 0.0, CEILING]]), down)
    torch.testing.assert_close(arriving, torch.full_like(arriving, FLOOR))


def test_r_is_taken_until_enough_has_been_seen_and_for_what_is_beyond_the_budget():
    model = between_plates()
    assert (from_the_floor(model) == GUESS).all()
    look_at_the_floor(model)
    shaded = from_the_floor(model)[0, :, 0] != GUESS
    assert shaded.sum() == round(unseen.MOST * 64)


def test_a_place_is_forgotten_when_nobody_looks_any_more():
    seen = SeenPlaces(1.0)
    here, there = torch.tensor([[0.3, 0.3, 0.3]]), torch.tensor([[-0.3, 0.3, 0.3]])
    seen.remember(here)
    seen.remember(there.expand(unseen.LIFE + 1, 3))
    assert not seen.unseen(there).any()
    assert seen.unseen(here).all()
    again = SeenPlaces(1.0)
    again.load_state_dict(seen.state_dict())
    assert again.unseen(here).all()
    assert not again.unseen(there).any()


def test_it_goes_with_hard_inter_reflection_alone():
    config = tiny_config()
    settings = dataclasses.replace(config.inter_reflection, mode="soft", unseen="shaded")
    with pytest.raises(UserError, match="no camera sees"):
        sphere_model(dataclasses.replace(config, inter_reflection=settings))


def test_switched_off_nothing_is_remembered():
    assert between_plates("radiance").seen_places is None
