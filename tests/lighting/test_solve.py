"""Maps and lamps together: lamps are found if there are any, and only then."""

from __future__ import annotations

import dataclasses
import math

import pytest
import torch
from torch.nn.functional import normalize

from neilfpp_method.fields.environment import EnvironmentLight
from neilfpp_method.fields.lamps import LampPlaces, Lamps
from neilfpp_method.fields.light import LightModel
from neilfpp_method.lighting.candidates import merge_lamps, propose
from neilfpp_method.lighting.fit import Evidence
from neilfpp_method.lighting.fit_points import FitPoints
from neilfpp_method.lighting.lamp_transport import from_lamps
from neilfpp_method.lighting.map_transport import from_texels
from neilfpp_method.lighting.objective import Objective
from neilfpp_method.lighting.solve import solve_light
from neilfpp_method.settings.types import LightFitConfig, MapLightConfig
from neilfpp_method.shading.brdf import GGX
from neilfpp_method.structures import Material, Observed
from tests.lighting.surfaces import material, patches

CONFIG = MapLightConfig(kind="auto", environment_height=12, fit=LightFitConfig(points=800))
STEPS = 150
LAMP = torch.tensor([[0.3, -0.2, 0.5]])
BULB = LampPlaces(LAMP, torch.zeros(1, 3))
"""Sends alike in all directions."""
PANEL = LampPlaces(LAMP, normalize(torch.tensor([[-0.7, 0.3, -0.6]]), dim=-1))
"""Sends most to the left, and nothing to the right of it."""


def table(count: int) -> Observed:
    """Points on a table, and on a ball of radius 0.25 on it, viewed from above."""
    generator = torch.Generator().manual_seed(3)
    half = count // 2
    flat = torch.cat((1.6 * torch.rand(half, 2, generator=generator) - 0.8, torch.zeros(half, 1)), -1)
    up = normalize(torch.randn(count - half, 3, generator=generator), dim=-1)
    up[:, 2] = up[:, 2].abs()
    position = torch.cat((flat, 0.25 * up - torch.tensor([0.4, 0.3, 0.0])))
    normal = torch.cat((torch.tensor([[0.0, 0.0, 1.0]]).expand(half, 3), up))
    wo = normalize(normal + 0.6 * normalize(torch.randn(count, 3, generator=generator), dim=-1), dim=-1)
    return Observed(position, normal, wo, torch.zeros(count, 3))


def photographed(lamp: LampPlaces | None, speckled: bool = False) -> tuple[Observed, Material]:
    """The table under an even sky, with or without a lamp above it that contributes about as much light."""
    seen = table(800)
    of = material(800) if speckled else patches(seen.position)
    sky = EnvironmentLight(12, 0.5)
    image = from_texels(sky, seen, of.roughness, GGX, None).outgoing(
        of, sky.log_radiance.exp().flatten(1).t()
    )
    if lamp is not None:
        carried = from_lamps(lamp, 0.06, seen, of.roughness, GGX, None)
        image = image + carried.outgoing(of, torch.tensor([[0.9, 0.7, 0.4]]))
    return dataclasses.replace(seen, pixel=image), of


def solve(
    light: LightModel,
    seen: Observed,
    of: Material,
    config: MapLightConfig,
    first: bool,
    base_color_known: bool = False,
) -> Evidence | None:
    """Solve for the light of open points of known roughness, in units of their median pixel."""
    objective = Objective("linear", seen.pixel.median().item(), STEPS, base_color_known)
    return solve_light(light, FitPoints(seen, of, GGX, None), objective, config, first)


def solved(seen: Observed, of: Material, rounds: int, base_color_known: bool = False) -> tuple[Lamps, object]:
    torch.manual_seed(0)
    light = LightModel(EnvironmentLight(12, 0.7), Lamps(4, 0.06))
    for number in range(rounds):
        evidence = solve(light, seen, of, CONFIG, number == 0, base_color_known)
    return light.lamps, evidence


@pytest.mark.parametrize("true", [BULB, PANEL], ids=["bulb", "panel"])
@pytest.mark.parametrize("known", [pytest.param(True, marks=pytest.mark.slow), False])
def test_a_lamp_is_found_with_its_position_intensity_and_kind(true, known):
    """Known base colours may vary arbitrarily; unknown ones are constant except for edges."""
    lamps, _ = solved(*photographed(true, speckled=known), rounds=3, base_color_known=known)
    assert lamps.count
    strongest = int(lamps.intensity.sum(-1).argmax())
    assert (lamps.position[strongest] - LAMP[0]).norm() < 0.03
    assert lamps.intensity[strongest].tolist() == pytest.approx([0.9, 0.7, 0.4], rel=0.1)
    assert lamps.intensity[strongest].sum() > 0.9 * lamps.intensity.sum(), "nothing is elsewhere"
    torch.testing.assert_close(lamps.axis[strongest], true.axis[0], rtol=0, atol=math.radians(10))


def test_under_only_a_sky_no_lamp_is_lit():
    lamps, _ = solved(*photographed(None), rounds=2)
    assert lamps.count == 0


def test_proposals_include_lit_lamps_and_keep_clear_of_surfaces():
    torch.manual_seed(0)
    lamps = Lamps(4, 0.06)
    lamps.place(LAMP, torch.ones(1, 3))
    surface = table(400).position
    places = propose(lamps, surface, 100)
    assert places.position.shape == places.axis.shape == (100, 3)
    assert torch.equal(places.position[:1], LAMP)
    assert torch.cdist(places.position[1:], surface).min() > 3 * 0.06
    assert ((places.position - LAMP).norm(dim=-1) < 0.2).sum() >= 5


def test_proposals_are_bulbs_and_panels_turned_to_the_scene():
    torch.manual_seed(0)
    places = propose(Lamps(4, 0.06), table(400).position, 200)
    length = places.axis.norm(dim=-1)
    bulb = length == 0
    assert 0.2 < bulb.float().mean() < 0.5
    torch.testing.assert_close(length[~bulb], torch.ones(int((~bulb).sum())))
    towards = (normalize(-places.position, dim=-1) * places.axis).sum(-1)[~bulb]
    assert (towards > 0).float().mean() > 0.75


def test_neighbouring_lamps_merge_with_their_joint_power():
    position = torch.tensor([[0.0, 0.0, 0.5], [0.06, 0.0, 0.5], [0.8, 0.0, 0.5], [-0.8, 0.0, 0.5]])
    intensity = torch.tensor([[3.0, 3.0, 3.0], [1.0, 1.0, 1.0], [2.0, 0.0, 0.0], [0.01, 0.01, 0.01]])
    axis = torch.tensor([[0.0, 0.0, -1.0], [0.0, 0.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, 0.0]])
    places = LampPlaces(position, axis)
    found = merge_lamps(places, intensity, torch.ones(4), max_lamps=4)
    torch.testing.assert_close(found.places.axis, axis[[0, 2]])
    torch.testing.assert_close(found.places.position, torch.tensor([[0.015, 0.0, 0.5], [0.8, 0.0, 0.5]]))
    torch.testing.assert_close(found.intensity, torch.tensor([[4.0, 4.0, 4.0], [2.0, 0.0, 0.0]]))
    assert len(merge_lamps(places, intensity, torch.ones(4), max_lamps=1).intensity) == 1
    assert len(merge_lamps(places, torch.zeros(4, 3), torch.ones(4), max_lamps=4).intensity) == 0


def test_panels_back_to_back_become_a_bulb():
    axis = torch.tensor([[0.0, 0.0, -1.0], [0.0, 0.0, 1.0]])
    found = merge_lamps(LampPlaces(LAMP.expand(2, 3), axis), torch.ones(2, 3), torch.ones(2), max_lamps=4)
    torch.testing.assert_close(found.places.axis, torch.zeros(1, 3))


def test_lamps_are_found_under_a_known_map_which_is_unchanged():
    seen, of = photographed(BULB)
    known = dataclasses.replace(CONFIG, map="sky.exr")
    environment, lamps = EnvironmentLight(4, 1.0), Lamps(4, 0.06)
    environment.show(torch.full((3, 48, 70), 0.5))  # finer than the fit needs it
    before = environment.log_radiance.clone()
    torch.manual_seed(2)
    for _ in range(3):
        evidence = solve(LightModel(environment, lamps), seen, of, known, first=False)
    assert torch.equal(environment.log_radiance, before)
    assert lamps.count
    assert 100 < evidence.points < 220  # a part of 800 points is some blocks
    assert (lamps.position[0] - LAMP[0]).norm() < 0.12
    beside = (lamps.position - LAMP).norm(dim=-1) < 0.3
    # The sky is known, so it cannot compensate for a part of the lamp.
    assert lamps.intensity[beside].sum().item() == pytest.approx(0.9 + 0.7 + 0.4, rel=0.15)


def test_under_only_a_known_sky_no_lamp_is_lit():
    seen, of = photographed(None)
    light = LightModel(EnvironmentLight(12, 0.5), Lamps(4, 0.06))
    torch.manual_seed(0)
    evidence = solve(light, seen, of, dataclasses.replace(CONFIG, map="sky.exr"), first=True)
    assert evidence.points == 800  # in the first decision each point is held back once
    assert light.lamps.count == 0


@pytest.mark.parametrize("count", [1, 3, pytest.param(5, marks=pytest.mark.slow)])
def test_too_few_points_give_no_lamp(count):
    """Of a few points none or one is held back: the evidence is finite, so that JSON can store it."""
    seen, of = photographed(None)
    few = torch.arange(count)
    lamps, evidence = solved(seen[few], of[few], rounds=1)
    assert evidence.points == count
    assert math.isfinite(evidence.gain)
    assert math.isfinite(evidence.deviation)
    assert lamps.intensity.isfinite().all()


def test_lamps_without_a_significant_gain_are_lit_only_with_lamps_if_undecided(monkeypatch):
    unsure = Evidence(gain=0.006, deviation=0.005, points=200)
    monkeypatch.setattr("neilfpp_method.lighting.solve.evidence", lambda gains: unsure)
    seen, of = photographed(BULB)
    lit = []
    for doubt in (False, True):
        torch.manual_seed(0)
        light, unit = LightModel(EnvironmentLight(12, 0.7), Lamps(4, 0.06)), seen.pixel.median().item()
        objective = Objective("linear", unit, STEPS)
        points = FitPoints(seen, of, GGX, None)
        solve_light(light, points, objective, CONFIG, first=False, lamps_if_undecided=doubt)
        lit.append(light.lamps.count)
    assert lit[0] == 0
    assert lit[1] > 0
