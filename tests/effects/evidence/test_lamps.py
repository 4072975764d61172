"""Lamps of the initial light are judged in held-back views: on synthetic balls, with and without a lamp."""

from __future__ import annotations

import dataclasses

import pytest
import torch

from neilfpp_method.effects.first_light import find_first_light
from neilfpp_method.effects.plan import Plan
from neilfpp_method.effects.request import EffectRequest
from neilfpp_method.effects.review import record_lamps
from neilfpp_method.fields.environment import EnvironmentLight
from neilfpp_method.fields.lamps import Lamps
from neilfpp_method.lighting import solver as solver_module
from neilfpp_method.lighting.fit import Evidence
from neilfpp_method.lighting.lamp_transport import from_lamps
from neilfpp_method.lighting.map_transport import from_texels
from neilfpp_method.settings.presets import preset
from neilfpp_method.shading import LOBES
from neilfpp_method.structures import Material, Observed
from tests.effects.balls import ball, data_of
from tests.scenes import sphere_model

LOBE = LOBES["ggx"]
COUNT, VIEWS, ROUGHNESS = 110, 12, 0.36


def lamp(position: tuple[float, float, float], intensity: float) -> Lamps:
    lamps = Lamps(2, 0.06)
    lamps.place(torch.tensor([position]), torch.full((1, 3), intensity))
    return lamps


def lit_by(lamps: Lamps, observed: Observed, material: Material) -> Observed:
    """The same points with the light of the lamps added to their pixels."""
    sent = from_lamps(lamps.lit_places, lamps.radius, observed, material.roughness, LOBE, None)
    added = sent.outgoing(material, lamps.lit_intensity)
    return dataclasses.replace(observed, pixel=observed.pixel + added)


@pytest.mark.parametrize("with_lamp", [True, False])
def test_a_lamp_explains_held_back_views_only_if_there_is_one(with_lamp):
    torch.manual_seed(1)
    color, ones = 0.2 + 0.6 * torch.rand(COUNT, 3), torch.ones(COUNT, 1)
    places, lamps = ball(color, ROUGHNESS * ones, 0 * ones, LOBE, VIEWS), lamp((0.0, -2.5, 1.5), 20.0)
    if with_lamp:
        material = Material(*(v[places.place] for v in (color, ROUGHNESS * ones, 0 * ones)))
        places = dataclasses.replace(places, observed=lit_by(lamps, places.observed, material))
    found = find_first_light(data_of(places, LOBE), metals=False)
    measured = found.lamp_trial(lamps, LOBE, None)
    assert measured.in_views
    assert measured.points == COUNT
    assert (measured.gain > 0) is with_lamp
    assert (measured.gain < -measured.deviation) is not with_lamp


def table_top() -> tuple[Observed, Material]:
    """Points of a grey table under an even light and a nearby lamp, and their material."""
    torch.manual_seed(0)
    position = torch.cat((2 * torch.rand(500, 2) - 1, torch.zeros(500, 1)), 1)
    normal = torch.tensor([0.0, 0.0, 1.0]).expand(500, 3)
    wo = torch.nn.functional.normalize(torch.randn(500, 3).abs() + 0.1, dim=-1)
    ones = torch.ones(500, 1)
    material = Material(0.5 * ones.expand(500, 3), ROUGHNESS * ones, 0 * ones)
    even = EnvironmentLight(16, 1.0)
    sent = from_texels(even, Observed(position, normal, wo, 0 * wo), material.roughness, LOBE, None)
    pixel = sent.outgoing(material, even.log_radiance.exp().flatten(1).t())
    return lit_by(lamp((0.2, 0.1, 0.5), 1.0), Observed(position, normal, wo, pixel), material), material


# The last test also starts with lamps that held-back views clearly show.
@pytest.mark.parametrize(
    ("gain", "kept"), [pytest.param(0.02, True, marks=pytest.mark.slow), (-0.002, True), (-0.02, False)]
)
def test_the_solver_starts_with_lamps_that_held_back_views_do_not_contradict(gain, kept):
    observed, material = table_top()
    fast = preset("fast")
    light = dataclasses.replace(fast.light, fit=dataclasses.replace(fast.light.fit, points=100))
    model = sphere_model(dataclasses.replace(fast, light=light))
    before = model.light.log_radiance.clone()
    judged = []

    def judge(proposed: Lamps, lobe: object, scene: object) -> Evidence:
        judged.append(proposed.count)
        return Evidence(gain, 0.01, 100, in_views=True)

    torch.manual_seed(0)
    solver = model.light_solver()
    evidence = solver.start(observed, material, None, judge)
    assert judged[0] >= 1
    assert (model.lamps.count > 0) is kept
    assert torch.equal(model.light.log_radiance, before) is not kept
    assert evidence.in_views is not kept
    assert evidence.points == (500 if kept else 100), "all points serve the start, not only those of a fit"
    plan = Plan.begin(EffectRequest("auto"), fast)
    decision = record_lamps(plan, evidence, model.lamps.count, step=0)[0]
    assert decision.on is kept
    assert ("in held-back views" in decision.reason) is not kept


@pytest.mark.parametrize("gain", [0.02, -0.02])
def test_later_fits_do_not_look_for_lamps_that_the_start_found_or_rejected(gain, monkeypatch):
    kinds = []

    def solve_light(light, points, objective, config, *arguments, **options):
        kinds.append(config.kind)
        return honest(light, points, objective, config, *arguments, **options)

    honest = solver_module.solve_light
    monkeypatch.setattr(solver_module, "solve_light", solve_light)
    observed, material = table_top()
    model = sphere_model(preset("fast"))
    torch.manual_seed(0)
    solver = model.light_solver()
    solver.start(observed, material, None, lambda *_: Evidence(gain, 0.01, 100, in_views=True))
    restored = model.light_solver()
    restored.load_state_dict(solver.state_dict())
    for later in (solver, restored):
        later.memory.remember(observed)
        monkeypatch.setattr(type(later.memory), "due", True)
        later.solve(model.brdf, None)
        assert (model.lamps.count > 0) is (gain > 0)
    assert kinds == ["auto"] + (2 * ["distant"] if gain < 0 else [])
