"""What the light solver takes from the initial light: the scale, and whether there are lamps."""

from __future__ import annotations

import dataclasses

import pytest
import torch

from neilfpp_method.fields.light import LightModel
from neilfpp_method.lighting import solver as solver_module
from neilfpp_method.lighting.fit import Evidence
from neilfpp_method.lighting.objective import Objective
from neilfpp_method.settings.presets import preset
from neilfpp_method.structures import Material, Observed
from tests.lighting.surfaces import material, points
from tests.scenes import sphere_model

HELPFUL = Evidence(0.1, 0.01, 400)
HARMFUL = Evidence(-0.1, 0.01, 400)


@pytest.mark.parametrize("in_views", [HELPFUL, HARMFUL], ids=["lamps", "no lamps"])
def test_the_first_fit_is_even_after_lamps_and_keeps_a_map_without_them(in_views, monkeypatch):
    counts: list[int] = []
    steps: list[int] = []
    maps: list[torch.Tensor] = []

    def one_lamp(light: LightModel, _: object, objective: Objective, *__: object, **___: object) -> Evidence:
        counts.append(light.lamps.count)
        steps.append(objective.steps)
        maps.append(light.light.log_radiance.clone())
        light.lamps.place(torch.tensor([[0.0, 0.0, 0.9]]), torch.ones(1, 3))
        return HELPFUL

    monkeypatch.setattr(solver_module, "solve_light", one_lamp)
    torch.manual_seed(0)
    fast = preset("fast")
    fit = dataclasses.replace(fast.light.fit, points=400, every=1)
    model = sphere_model(dataclasses.replace(fast, light=dataclasses.replace(fast.light, fit=fit)))
    rows = torch.linspace(-1, 1, model.light.log_radiance.shape[1])
    model.light.log_radiance.copy_(rows[:, None].expand_as(model.light.log_radiance))
    surface, made_of = points(400), material(400)
    observed = Observed(surface.position, surface.normal, surface.wo, torch.ones(400, 3))
    solver = model.light_solver()
    assert solver.seeks_start
    measured = solver.start(observed, made_of, None, lambda *_: in_views)
    assert measured is in_views
    assert not solver.seeks_start

    model.brdf.forward = lambda x: Material(*(value[: len(x)] for value in vars(made_of).values()))
    solver.memory.remember(observed)
    assert solver.due
    solver.solve(model.brdf, None)
    assert counts == [0, 0]
    assert steps == [300, 100], "the fits of the start begin without lamps and take longer"
    torch.testing.assert_close(maps[1].mean((1, 2)), torch.zeros(3), atol=0.1, rtol=0)
    is_even = maps[1].std((1, 2)).max() < 1e-5
    assert is_even == (in_views is HELPFUL)
