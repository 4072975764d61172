"""Each preset, at its real sizes, takes a step of every stage."""

from __future__ import annotations

import dataclasses

import pytest
import torch

from neilfpp_method.hosts.volsdf import VolSdfHost
from neilfpp_method.model import NeilfModel
from neilfpp_method.schedule import Stage, active_losses, weigh
from neilfpp_method.settings.facts import SceneFacts
from neilfpp_method.settings.presets import PRESETS, preset
from neilfpp_method.structures import OrientedPoints
from tests.scenes import sphere_batch


@pytest.mark.parametrize("name", PRESETS)
def test_a_step_of_every_stage(name):
    torch.manual_seed(0)
    config = preset(name)
    # An untrained surface is fog; here whatever a ray meets is shaded.
    config = dataclasses.replace(config, shading=dataclasses.replace(config.shading, hit_share=1e-3))
    facts = SceneFacts("linear", 0.2, 3.0, "constant", log_gains=(0.1, 0.0, 0.0, -0.1, 0.0, 0.0))
    direction = torch.nn.functional.normalize(torch.randn(50, 3), dim=-1)
    host = VolSdfHost(
        config, facts.radiance_scale, facts.background, points=OrientedPoints(0.6 * direction, direction)
    )
    model = NeilfModel(host, config, facts)
    batch = sphere_batch(6, spread=0.3)
    for stage in Stage:
        model.freeze_for(stage)
        expected = active_losses(stage, config)
        terms = model.losses(batch, stage)
        assert terms.keys() == expected.keys()  # every loss of the table, and no other
        weigh(terms, expected).loss.backward()
        moving = [p for p in model.parameters() if p.requires_grad and p.grad is not None]
        assert moving
        assert all(p.grad.isfinite().all() for p in moving)
