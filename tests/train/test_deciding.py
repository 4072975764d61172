"""Decisions between the steps of a training apply to what is measured after them."""

from __future__ import annotations

from pathlib import Path

from neilfpp_method.effects import following
from neilfpp_method.effects.measurement import Measurement
from neilfpp_method.effects.plan import Plan
from neilfpp_method.effects.request import parse_effects
from neilfpp_method.effects.review import LightReview
from neilfpp_method.lighting.solver import LightSolver
from neilfpp_method.model import NeilfModel
from neilfpp_method.shading import LOBES
from neilfpp_method.train import deciding
from neilfpp_method.train.deciding import Subject, review_before_material
from tests.effects.balls import first_light_of_sky
from tests.train.small_runs import small_config, small_training, solved_light


def test_lamps_of_the_initial_light_are_sought_with_the_decided_lobe(
    capture: Path, tmp_path: Path, monkeypatch
) -> None:
    run = small_training(capture, tmp_path, solved_light(small_config()))
    plan, started = Plan.begin(parse_effects("auto"), run.config), []

    def review_light(plan: Plan, model: NeilfModel, *_: object) -> LightReview:
        decision = plan.decide("long-tails", Measurement("gain", -0.1, 0.01, 0.0, 100), step=4)
        model.use(plan.config)
        return LightReview([decision], first_light_of_sky())

    def start_with(model: NeilfModel, solver: LightSolver, first: object) -> None:
        started.append(solver.lobe)

    monkeypatch.setattr(deciding, "review_light", review_light)
    monkeypatch.setattr(following, "start_with", start_with)
    assert run.light_solver.lobe is LOBES["ggx"]
    subject = Subject(plan, run.model, run.light_solver, run.reporter.say, run.pixels, 0)
    review_before_material(subject, step=4)
    assert started == [LOBES["spherical_gaussian"]]
