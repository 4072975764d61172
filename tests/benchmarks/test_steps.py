"""The timed steps are complete steps: in every stage, each trained field gets a gradient."""

from __future__ import annotations

import pytest

from benchmarks.steps import model_of, step_of
from neilfpp_method.schedule import Stage


@pytest.mark.parametrize("stage", Stage)
def test_a_step_gives_gradients_to_the_trained_fields(stage):
    model = model_of("fast")
    before = {name: value.clone() for name, value in model.state_dict().items() if name.startswith("brdf.")}
    step_of(model, stage, rays=64)()
    groups = model.parameter_groups()
    moved = {
        name
        for name, parameters in groups.items()
        if any(p.grad is not None and p.grad.any() for p in parameters)
    }
    expected = {
        Stage.SDF_INIT: {"geometry", "radiance"},
        Stage.MATERIAL_INIT: {"brdf"},
        Stage.JOINT: {"geometry", "brdf"},
    }
    assert expected[stage] <= moved
    assert all(value.equal(model.state_dict()[name]) for name, value in before.items())  # the rates are 0
