"""The decision on the diffuse lobe, under the light of a half-trained model."""

from __future__ import annotations

import dataclasses

import pytest
import torch

from neilfpp_method.effects.places.gathering import Places
from neilfpp_method.effects.places.lit import LitPlaces, light_up
from neilfpp_method.effects.plan import Plan
from neilfpp_method.effects.request import parse_effects
from neilfpp_method.effects.review import review_diffuse
from neilfpp_method.model import NeilfModel
from neilfpp_method.settings.plain import changed
from neilfpp_method.settings.presets import preset
from neilfpp_method.shading import LOBES
from tests.effects.balls import ball, sky
from tests.scenes import sphere_model

COUNT, VIEWS = 400, 10


def smooth_paint(lobe: str) -> Places:
    one = torch.ones(COUNT, 1)
    return ball(0.7 * one.expand(-1, 3), 0.2 * one, 0 * one, LOBES[lobe], VIEWS, sky())


def half_trained(places: Places, effects: str = "auto", lobe: str = "ggx") -> tuple[Plan, NeilfModel]:
    """A model under the true sky, and its plan."""
    config = changed(preset("fast"), {"shading.lobe": lobe})
    plan = Plan.begin(parse_effects(effects), config)
    model = sphere_model(plan.config)
    model.light.resample(sky().log_radiance)
    model.facts = dataclasses.replace(model.facts, median_radiance=places.observed.pixel.median().item())
    return plan, model


@pytest.mark.parametrize("lobe", ["ggx", "ggx_burley"])
def test_the_lobe_of_the_images_is_recognised(lobe):
    places = smooth_paint(lobe)
    plan, model = half_trained(places)
    (decision,) = review_diffuse(plan, model, light_up(model, places), 1000)
    assert decision.on == (lobe == "ggx_burley")
    assert abs(decision.evidence.value) > 2 * decision.evidence.deviation
    assert plan.config.shading.lobe == model.config.shading.lobe == lobe
    assert model.lobe is LOBES[lobe]


@pytest.fixture(scope="module")
def rough_diffuse() -> tuple[Places, LitPlaces]:
    """Places of a rough diffuse lobe, also under the light of a half-trained model."""
    places = smooth_paint("ggx_burley")
    return places, light_up(half_trained(places)[1], places)


@pytest.mark.parametrize(
    ("effects", "lobe"),
    [
        ("auto,-rough-diffuse", "ggx"),
        ("none", "ggx"),
        ("as-set", "ggx"),
        ("all", "ggx"),
        ("auto", "ggx_burley"),
        ("auto,-long-tails", "ggx"),
    ],
)
def test_what_is_on_or_decided_stays(rough_diffuse, effects, lobe):
    places, lit = rough_diffuse
    plan, model = half_trained(places, effects, lobe)
    before = model.config.shading.lobe
    assert review_diffuse(plan, model, lit, 1000) == []
    assert model.config.shading.lobe == before


def test_until_it_is_measured_it_is_off():
    plan = Plan.begin(parse_effects("auto"), preset("fast"))
    assert plan.newest("rough-diffuse").reason == "off until a half-trained model shows a gain"
    assert plan.is_open("rough-diffuse")
    assert plan.config.shading.lobe == "ggx"
