"""Effects that are off cost nothing: counts of fits, fields, parameters and steps with and without each.

`test_plan.py` counts traced rays, look-ups of the map and evaluations of the specular lobe.
"""

from __future__ import annotations

import pytest

from neilfpp_method.effects.catalogue import EFFECTS
from neilfpp_method.effects.plan import Plan
from neilfpp_method.effects.request import parse_effects
from neilfpp_method.hosts.volsdf import VolSdfHost
from neilfpp_method.lighting import fit
from neilfpp_method.lighting.fit import fit_light
from neilfpp_method.model import NeilfModel
from neilfpp_method.schedule import Stage, stage_steps
from neilfpp_method.settings.facts import SceneFacts
from neilfpp_method.settings.plain import changed
from neilfpp_method.settings.presets import EXPOSURE_RATE
from neilfpp_method.settings.types import NeilfConfig
from tests.scenes import sphere_batch, sphere_model, tiny_config
from tests.train.small_runs import short_light_fits, solved_light


def settings(effects: str) -> NeilfConfig:
    """The tiny settings with a solved light, changed by a value of `--effects`."""
    config = changed(
        solved_light(tiny_config()), {"shading.hit_share": 0.2, "optimizer.exposure": EXPOSURE_RATE}
    )
    return Plan.begin(parse_effects(effects), config).config


@pytest.mark.parametrize("lamps", [True, False])
@short_light_fits()
def test_without_lamps_there_is_one_fit_and_no_candidate(lamps, monkeypatch):
    model, sources = sphere_model(settings("all" if lamps else "all,-lamps")), []
    monkeypatch.setattr(fit, "fit_light", lambda *a: sources.append(a[1].sources.shape[2]) or fit_light(*a))
    solver = model.light_solver()
    while not solver.due:
        solver.observe(model.step(sphere_batch(), Stage.MATERIAL_INIT))
    solver.solve(model.brdf, model.scene)
    texels = model.light.log_radiance[0].numel()
    if lamps:
        assert max(sources) > texels
    else:
        assert sources == [texels]
        assert model.lamps.count == 0


def test_without_an_open_background_there_is_no_field_of_it():
    def background_parameters(effects: str) -> int:
        config = settings(effects)
        host = VolSdfHost(config, SceneFacts("linear", 0.2, 3.0, config.background.kind))
        return sum(parameter.numel() for parameter in host.parameter_groups().get("background", []))

    assert background_parameters("all") > 0
    assert background_parameters("all,-background") == 0


def test_without_exposures_photographs_have_no_gains():
    facts = SceneFacts("linear", 0.2, 3.0, "constant", log_gains=(0.1, 0.0, 0.0, -0.1, 0.0, 0.0))

    def model(effects: str) -> NeilfModel:
        config = settings(effects)
        return NeilfModel(VolSdfHost(config, facts), config, facts)

    assert model("all").gains is not None
    without = model("all,-exposure")
    assert without.gains is None
    assert "exposure" not in without.losses(sphere_batch(), Stage.SDF_INIT)


def test_without_a_joint_stage_there_are_no_steps_of_it():
    assert stage_steps(settings("all").train)[Stage.JOINT] > 0
    assert stage_steps(settings("all,-joint-stage").train)[Stage.JOINT] == 0


def test_every_effect_that_can_be_switched_changes_settings():
    everything = settings("all")
    fixed = {name for name, effect in EFFECTS.items() if effect.obstacle(everything)}
    assert fixed == {"response"}
    for name in EFFECTS.keys() - fixed:
        without = settings(f"all,-{name}")
        assert not EFFECTS[name].is_on(without)
        assert without != everything
