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
from neilfpp_method.settings.types import MapLightConfig
from neilfpp_method.structures import Material, Observed
from tests.lighting.surfaces import material, points
from tests.scenes import sphere_model

HELPFUL = Evidence(0.1, 0.01, 400)
HARMFUL = Evidence(-0.1, 0.01, 400)


@pytest.mark.parametrize("in_views", [HELPFUL, HARMFUL], ids=["lamps", "no lamps"])
def test_later_fits_start_from_the_initial_light_and_keep_the_places_of_its_lamps(in_views, monkeypatch):
    steps: list[int] = []
    kinds: list[str] = []

    def one_lamp(light: LightModel, _: object, objective: Objective, config: MapLightConfig, *__, **___):
        steps.append(objective.steps)
        kinds.append(config.kind)
        if config.kind == "auto":
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
    count, before = model.lamps.count, model.light.log_radiance.clone()
    assert count == (in_views is HELPFUL)

    model.brdf.forward = lambda x: Material(*(value[: len(x)] for value in vars(made_of).values()))
    solver.memory.remember(observed)
    assert solver.due
    evidence = solver.solve(model.brdf, None)
    if in_views is HELPFUL:
        assert evidence is None
        assert steps == [300], "lamps are not sought again"
        assert model.lamps.lit_places.position.tolist() == [pytest.approx([0.0, 0.0, 0.9])]
        assert not torch.equal(model.lamps.lit_intensity, torch.ones(1, 3))
        assert not torch.equal(model.light.log_radiance, before)
        model.light.set_even(True)
        solver.memory.remember(observed)
        solver.solve(model.brdf, None)
        assert model.light.log_radiance.std((1, 2)).max() < 1e-5, "an even light is fitted as a whole"
    else:
        assert (steps, kinds) == ([300, 100], ["auto", "distant"])
    assert model.lamps.count == count
