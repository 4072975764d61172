"""Evidence from places that many views show, with known material and light."""

from __future__ import annotations

import dataclasses

import pytest
import torch

from neilfpp_method.effects.evidence.material import THRESHOLD, judge_material
from neilfpp_method.effects.evidence.noise import lobe_noise
from neilfpp_method.effects.places.data import ROWS
from neilfpp_method.effects.places.fit import Permitted, PlaceFit, fit_places, place_errors
from neilfpp_method.effects.places.gathering import Places
from neilfpp_method.effects.places.grid import METALLICS
from neilfpp_method.fields.brdf import BrdfField
from neilfpp_method.fields.environment import EnvironmentLight
from neilfpp_method.settings.presets import preset
from neilfpp_method.shading import LOBES, Lobe
from tests.effects.balls import ball, data_of, sky
from tests.scenes import sphere_model, tiny_config
from tests.train.small_runs import solved_light

LOBE = LOBES["spherical_gaussian"]
PLACES, VIEWS = 40, 9


def ball_of(
    metallic: float,
    lobe: Lobe | None = LOBE,
    environment: EnvironmentLight | None = None,
    brightness: float = 1.0,
    count: int = PLACES,
) -> Places:
    """A ball of one material, with `count` places."""
    one, color = torch.ones(count, 1), brightness * torch.tensor([[0.6, 0.5, 0.4]]).expand(count, 3)
    return ball(color, 0.28 * one, metallic * one, lobe, VIEWS, environment)


def gain_of_metals(places: Places) -> tuple[float, float]:
    """Mean reduction of the error in held-back views by metals, and the share of places that are then
    metal.
    """
    # With half of the seeds, one of forty painted places in the dark becomes metal.
    torch.manual_seed(5)
    split = data_of(places, LOBE).hold_back(0, 3)
    paint, metal = (fit_places(split.known, Permitted(metals)) for metals in (False, True))
    errors = [place_errors(fit, split.held_back).mean().item() for fit in (paint, metal)]
    assert paint.metallic.max() == 0
    return errors[0] - errors[1], (metal.metallic > len(METALLICS) // 2).float().mean().item()


def test_metals_reduce_the_error_for_a_metal_ball_and_not_for_a_painted_one():
    of_metal, share = gain_of_metals(ball_of(1.0))
    of_paint, share_of_paint = gain_of_metals(ball_of(0.0))
    assert of_metal > 2 * THRESHOLD
    assert share > 0.2  # the dark side of the sky contains little information
    assert of_paint < 0.2 * THRESHOLD
    assert share_of_paint == 0


def judged(places: Places, *names: str) -> dict:
    return judge_material(data_of(places, LOBE), frozenset(names), metals=False).measured


def test_specular_reflection_is_found_on_a_shiny_ball_and_not_on_a_dull_one():
    shiny = judged(ball_of(0.0), "reflection", "environment-map", "coloured-light")
    assert shiny["reflection"].value > 0
    # A highlight of 4 % is a large part of what a dark surface sends.
    assert judged(ball_of(0.0, brightness=0.2), "reflection")["reflection"].favours(False)
    assert shiny["environment-map"].favours(False)
    assert not shiny["coloured-light"].favours(False)
    assert not judged(ball_of(0.0, None), "reflection")["reflection"].favours(False)


def test_colours_of_the_light_are_distinguished_from_paint():
    """A red window and a blue sky: no paint of one colour looks like this from all sides."""
    window = sky()
    window.log_radiance[1:, ROWS // 4 : 3 * ROWS // 8, 10:14] -= 2.0
    window.log_radiance[0, : ROWS // 2] -= 1.0
    found = judged(ball_of(0.0, LOBE, window, count=4 * PLACES), "coloured-light")["coloured-light"]
    assert found.value > 3 * found.deviation


@pytest.mark.parametrize(("roughness", "worth_it"), [(1, True), (9, False)])
def test_the_lobe_is_sampled_where_surfaces_are_smooth(roughness, worth_it):
    torch.manual_seed(0)
    places = ball_of(1.0)
    fit = PlaceFit(
        sky().log_radiance,
        torch.full((PLACES, 3), 0.5),
        torch.full((PLACES,), roughness),
        torch.full((PLACES,), len(METALLICS) - 1),
    )
    found = lobe_noise(sphere_model(solved_light(tiny_config())), places, fit)
    assert found.samples == PLACES
    assert found.favours(False) is worth_it


def test_a_single_roughness_is_the_same_everywhere_and_is_trained():
    config = preset("fast")
    field = BrdfField(dataclasses.replace(config.brdf, varying_roughness=False), config.encoding, 1.0)
    x = torch.rand(5, 3)
    material = field(x)
    assert material.roughness.unique().numel() == 1
    assert field.with_gradients(x).roughness_gradient.abs().max() == 0
    material.roughness.sum().backward()
    assert field.mlp.layers[-1].bias.grad[3] > 0
    assert field.mlp.layers[-1].weight.grad is None


def test_without_metals_metallic_is_zero_and_not_trained():
    config = preset("fast")
    field = BrdfField(config.brdf, config.encoding, 1.0)
    x = torch.rand(5, 3)
    assert field(x).metallic.min() > 0
    field.metals = False
    sample = field.with_gradients(x)
    assert sample.material.metallic.max() == 0
    assert sample.metallic_gradient.abs().max() == 0
    field(x).metallic.sum().backward() if field(x).metallic.requires_grad else None
    assert field(x).roughness.requires_grad
    assert field.mlp.layers[-1].bias.grad is None or field.mlp.layers[-1].bias.grad[4] == 0
