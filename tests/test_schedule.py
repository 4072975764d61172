"""The stage table (METHOD §4), and the losses and rates that follow from it."""

from __future__ import annotations

import dataclasses
import math

import pytest
import torch

from neilfpp_method.errors import UserError
from neilfpp_method.schedule import (
    Stage,
    StagePosition,
    active_losses,
    learning_rate,
    rate_factor,
    stage_at,
    surface_width_limit,
    weigh,
)
from neilfpp_method.settings.plain import from_dict, to_dict
from neilfpp_method.settings.presets import PRESETS, fixed_geometry, preset
from neilfpp_method.settings.types import OptimizerConfig, TrainConfig
from neilfpp_method.structures import LossTerm

# Table 1 of the paper.
TABLE = {
    Stage.SDF_INIT: "volume eikonal hessian surface point_cloud",
    Stage.MATERIAL_INIT: "inter_reflection physical smoothness lambertian",
    Stage.JOINT: "inter_reflection volume eikonal hessian surface physical smoothness lambertian",
}


@pytest.mark.parametrize("stage", Stage)
def test_paper_ngp_computes_the_losses_of_the_table(stage):
    assert set(active_losses(stage, preset("paper-ngp"))) == set(TABLE[stage].split())


def test_the_joint_stage_lowers_hessian_and_surface():
    config = preset("paper-mlp")
    first, last = active_losses(Stage.SDF_INIT, config), active_losses(Stage.JOINT, config)
    assert (first["hessian"], last["hessian"]) == (1e-3, 1e-4)
    assert (first["surface"], last["surface"]) == (1e-3, 1e-4)


def test_the_weight_of_the_hessian_grows_only_in_sdf_init():
    config = preset("fast")
    weights = [active_losses(Stage.SDF_INIT, config, share=share) for share in (0.0, 0.5, 1.0)]
    start, end, in_joint = config.host.loss.hessian
    assert end > start
    assert [w["hessian"] for w in weights] == pytest.approx([start, (start * end) ** 0.5, end])
    assert [w["eikonal"] for w in weights] == [config.host.loss.eikonal] * 3
    assert active_losses(Stage.JOINT, config, share=1.0)["hessian"] == in_joint


@pytest.mark.parametrize("stage", Stage)
def test_given_geometry_has_no_losses_of_g(stage):
    """Also with the stages of the paper, for a host that has no stages of its own."""
    of_geometry = {"eikonal", "hessian", "surface", "point_cloud", "patches", "mask"}
    assert not of_geometry & active_losses(stage, fixed_geometry(preset("fast"))).keys()


def factors(config: OptimizerConfig, stage: Stage, steps: list[int], length: int) -> list[float]:
    return [rate_factor(config, StagePosition(stage, step, length)) for step in steps]


def test_every_field_has_a_learning_rate():
    """A host of another project may have fields with any name, also that of another setting."""
    config = OptimizerConfig(geometry=1e-2, radiance=2e-2, brdf=3e-2)
    rates = {
        name: learning_rate(config, name) for name in ("brdf", "radiance", "background", "hair", "joint")
    }
    assert rates == {"brdf": 3e-2, "radiance": 2e-2, "background": 2e-2, "hair": 1e-2, "joint": 1e-2}


def test_rates_decrease_smoothly_or_in_drops():
    config = OptimizerConfig(joint=0.5, final=(0.01, 0.1, 0.01), drops=(0, 1, 2))
    assert factors(config, Stage.SDF_INIT, [0, 50, 100], 100) == pytest.approx([1.0, 0.1, 0.01])
    assert factors(config, Stage.MATERIAL_INIT, [0, 49, 50, 99, 100], 100) == pytest.approx(
        [1.0, 1.0, 0.1, 0.1, 0.1]
    )
    assert factors(config, Stage.JOINT, [0, 29, 30, 59, 60, 90], 90) == pytest.approx(
        [0.5, 0.5, 0.05, 0.05, 0.005, 0.005]
    )


def test_rates_rise_from_a_tenth():
    """The published code multiplies the rate by 10^(1/100) from one step to the next."""
    config = OptimizerConfig(joint=1.0, final=(1.0, 1.0, 1.0), warm_up=100)
    found = factors(config, Stage.JOINT, [0, 1, 50, 99, 100, 101], 1000)
    assert found == pytest.approx([0.1, 0.1 * 10**0.01, 0.1 * 10**0.5, 10**-0.01, 1.0, 1.0])


def test_an_effect_that_is_off_has_no_loss():
    config = preset("fast")
    off = dataclasses.replace(config, light=dataclasses.replace(config.light, inter_reflection="off"))
    assert "inter_reflection" not in active_losses(Stage.JOINT, off)
    matte = dataclasses.replace(config, shading=dataclasses.replace(config.shading, specular=False))
    assert not {"smoothness", "lambertian"} & set(active_losses(Stage.JOINT, matte))


def test_stages_follow_one_another():
    config = TrainConfig(sdf_steps=2, material_steps=3, joint_steps=1)
    stages = [stage_at(step, config) for step in range(7)]
    assert [(p.stage.value, p.step) for p in stages[:6]] == [
        ("sdf_init", 0),
        ("sdf_init", 1),
        ("material_init", 0),
        ("material_init", 1),
        ("material_init", 2),
        ("joint", 0),
    ]
    assert stages[6].step == stages[6].length  # over


def test_the_separate_pipeline_has_no_joint_stage():
    config = TrainConfig(sdf_steps=1, material_steps=1, joint_steps=0)
    assert stage_at(5, config).stage is Stage.MATERIAL_INIT


def test_weigh_sums_terms_and_refuses_those_without_weight():
    terms = {"volume": LossTerm(torch.tensor([1.0, 3.0])), "eikonal": LossTerm(torch.tensor([10.0]))}
    total = weigh(terms, {"volume": 2.0, "eikonal": 0.1})
    assert total.loss.item() == pytest.approx(2.0 * 2.0 + 0.1 * 10.0)
    assert {name: value.item() for name, value in total.terms.items()} == {"volume": 2.0, "eikonal": 10.0}
    with pytest.raises(KeyError):
        weigh(terms, {"volume": 1.0})


@pytest.mark.parametrize("name", PRESETS)
def test_settings_survive_json(name):
    import json

    config = preset(name)
    assert from_dict(type(config), json.loads(json.dumps(to_dict(config)))) == config


def test_settings_of_another_version_are_refused_by_name():
    with pytest.raises(UserError, match=r"config.train: unknown setting 'warp'"):
        from_dict(type(preset("fast")), {"train": {"warp": 9}})
    with pytest.raises(UserError, match=r"config.train.rays: 'many' where int belongs"):
        from_dict(type(preset("fast")), {"train": {"rays": "many"}})
    with pytest.raises(UserError, match=r"config.shading.lobe: 'blinn' is not a choice"):
        from_dict(type(preset("fast")), {"shading": {"lobe": "blinn"}})


def test_an_unknown_preset_is_named():
    names = "fast, balanced, best, paper-mlp, paper-ngp, paper-ngp-hdr"
    with pytest.raises(UserError, match=f"unknown preset 'turbo'; choose one of {names}"):
        preset("turbo")


def test_the_surface_width_is_bounded_from_sdf_init_on():
    fast = preset("fast").host.volume
    widths = [surface_width_limit(fast, StagePosition(Stage.SDF_INIT, k, 100)) for k in (0, 50, 99)]
    assert widths[0] == pytest.approx(fast.beta_init)
    assert widths[1] == pytest.approx(math.sqrt(fast.beta_init * fast.beta_final))
    assert widths[1] > widths[2] > fast.beta_final
    assert surface_width_limit(fast, StagePosition(Stage.JOINT, 0, 100)) == fast.beta_final
    assert surface_width_limit(fast, StagePosition(Stage.MATERIAL_INIT, 0, 100)) == math.inf
    published = preset("paper-mlp").host.volume
    assert surface_width_limit(published, StagePosition(Stage.SDF_INIT, 99, 100)) == math.inf
