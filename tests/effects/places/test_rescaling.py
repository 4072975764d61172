"""The correction of the scale between light and base colour."""

from __future__ import annotations

import math

import pytest
import torch
from torch import nn

from neilfpp_method.effects.places import rescaling
from neilfpp_method.effects.places.gathering import Places
from neilfpp_method.effects.places.lit import light_up
from neilfpp_method.effects.places.rescaling import correct_final_scale, correct_scale
from neilfpp_method.lighting.solver import MapSolver
from neilfpp_method.model import NeilfModel
from neilfpp_method.structures import Material
from tests.effects.balls import ball
from tests.effects.places.test_search import LOBE, fine_sky, trained_to

COUNT, VIEWS = 160, 10
BASE_COLOR, ROUGHNESS = 0.3, 0.25


def painted(base_color: float, metallic: float = 0.0) -> Material:
    return Material(*(torch.full((1, n), v) for n, v in ((3, base_color), (1, ROUGHNESS), (1, metallic))))


@pytest.fixture(scope="module")
def places() -> Places:
    """A ball of glossy paint under a sky."""
    material = (value.expand(COUNT, -1) for value in vars(painted(BASE_COLOR)).values())
    return ball(*material, LOBE, VIEWS, fine_sky())


def mis_scaled(factor: float, places: Places, metallic: float = 0.0) -> tuple[NeilfModel, MapSolver]:
    """A model with base colours that are too bright by a factor, under a light that is too weak by it."""
    model = trained_to(painted(BASE_COLOR * factor, metallic), places)
    model.light.log_radiance.data -= math.log(factor)
    solver = model.light_solver()
    solver.log_mean_base_color.fill_(math.log(BASE_COLOR * factor))
    return model, solver


@pytest.mark.parametrize("correct", [correct_scale, correct_final_scale])
@pytest.mark.parametrize("factor", [0.75, 1.0, 1.3])
def test_the_true_scale_is_found_and_kept_by_later_fits(places: Places, factor: float, correct):
    model, solver = mis_scaled(factor, places)
    lit = light_up(model, places)
    rescaled = correct(model, solver, lit)
    assert rescaled.before == pytest.approx(BASE_COLOR * factor, rel=5e-3)
    assert rescaled.factor == pytest.approx(1 / factor, rel=0.06)
    with torch.no_grad():
        learned = model.brdf(places.observed.position).base_color
    assert learned.median() == pytest.approx(BASE_COLOR, rel=0.06)
    torch.testing.assert_close(
        model.light.log_radiance.mean(), fine_sky().log_radiance.mean(), atol=0.06, rtol=0
    )
    assert solver.log_mean_base_color.exp() == pytest.approx(BASE_COLOR, rel=0.06)
    changed = light_up(model, places)
    torch.testing.assert_close(
        lit.dimmed(rescaled.factor).parts.mean(), changed.parts.mean(), rtol=0.02, atol=0
    )


def test_after_the_last_step_diffuse_light_stays_exactly_the_same(places: Places):
    model, solver = mis_scaled(1.3, places)
    with torch.no_grad():
        before = model.brdf(places.observed.position).base_color * model.light.log_radiance.exp().mean()
        correct_final_scale(model, solver, light_up(model, places))
        after = model.brdf(places.observed.position).base_color * model.light.log_radiance.exp().mean()
    torch.testing.assert_close(after, before)


def test_no_surface_becomes_brighter_than_snow(places: Places, monkeypatch):
    """Even if the brightest scale has the lowest error."""
    model, solver = mis_scaled(2.0, places)
    monkeypatch.setattr(rescaling, "lowest_scale", lambda errors, max_rise: max(errors))
    rescaled = correct_scale(model, solver, light_up(model, places))
    assert rescaled.factor > 1
    assert rescaled.before * rescaled.factor <= 0.9


def test_a_known_scale_is_not_changed(places: Places):
    model, solver = mis_scaled(1.3, places)
    before = model.light.log_radiance.clone()
    solver.log_mean_base_color.fill_(math.inf)
    assert correct_scale(model, solver, light_up(model, places)) is None
    assert torch.equal(model.light.log_radiance, before)


class MostlyMetal(nn.Module):
    """Metal below a height that leaves 30 % of a unit ball to paint; its base colours are too bright."""

    def __init__(self, factor: float) -> None:
        super().__init__()
        self.factor = factor

    def forward(self, x: torch.Tensor) -> Material:
        is_metal = x[:, 2:] < 0.4
        base_color = self.factor * torch.where(is_metal, 0.7, BASE_COLOR).expand(-1, 3)
        return Material(base_color, torch.full_like(x[:, :1], ROUGHNESS), is_metal.float())

    def brighten(self, base_color: float, factor: float) -> None:
        self.factor *= factor


def test_a_little_paint_on_an_object_of_metal_reveals_the_scale(places: Places):
    true = MostlyMetal(1.0)(places.shared_points().position)
    mixed = ball(true.base_color, true.roughness, true.metallic, LOBE, VIEWS, fine_sky())
    model, solver = mis_scaled(1.3, mixed)
    model.brdf = MostlyMetal(1.3)
    assert correct_scale(model, solver, light_up(model, mixed)) is not None
    assert model.brdf.factor == pytest.approx(1.0, rel=0.06)


def test_metals_do_not_reveal_the_scale(places: Places):
    model, solver = mis_scaled(1.3, places, metallic=0.9)
    assert correct_scale(model, solver, light_up(model, places)) is None


def test_a_white_field_can_become_brighter(places: Places):
    brdf = mis_scaled(1.0, places)[0].brdf
    before = brdf.mlp.layers[-1].bias.clone()
    brdf.brighten(1.0, 1.3)
    assert torch.equal(brdf.mlp.layers[-1].bias, before)
