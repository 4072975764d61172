"""Decisions between the steps of a training apply to what is measured after them."""

from __future__ import annotations

import dataclasses
from pathlib import Path

import pytest

from neilfpp_method.effects import following
from neilfpp_method.effects.measurement import Measurement
from neilfpp_method.effects.places.gathering import Places
from neilfpp_method.effects.plan import Plan
from neilfpp_method.effects.request import parse_effects
from neilfpp_method.effects.review import LightReview
from neilfpp_method.lighting.solver import LightSolver
from neilfpp_method.model import NeilfModel
from neilfpp_method.shading import LOBES
from neilfpp_method.train import deciding, loop
from neilfpp_method.train.deciding import Subject, correct_final_scale, review_before_material
from neilfpp_method.train.loop import train
from neilfpp_method.train.training import Training
from tests.effects.balls import first_light_of_sky
from tests.effects.places.test_rescaling import BASE_COLOR, mis_scaled, places  # noqa: F401, a fixture
from tests.train.small_runs import few_steps, small_config, small_training, solved_light


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


@pytest.mark.parametrize("leaves_out_joint", [False, True])
def test_the_scale_is_corrected_once_after_the_last_step(
    capture: Path, tmp_path: Path, monkeypatch, leaves_out_joint: bool
) -> None:
    run, corrected = small_training(capture, tmp_path, few_steps()), []

    def review(run: Training, step: int) -> None:
        if leaves_out_joint and step > 0:
            run.config = dataclasses.replace(
                run.config, train=dataclasses.replace(run.config.train, joint_steps=0)
            )

    monkeypatch.setattr(loop, "review_before_stage", review)
    monkeypatch.setattr(loop, "correct_final_scale", lambda run, step: corrected.append(step))
    train(run)
    steps = run.config.train
    assert corrected == [steps.sdf_steps + steps.material_steps + (0 if leaves_out_joint else 1)]


def test_the_final_correction_is_printed(
    capture: Path,
    tmp_path: Path,
    monkeypatch,
    places: Places,  # noqa: F811
) -> None:
    run, said = small_training(capture, tmp_path, small_config()), []
    model, solver = mis_scaled(1.3, places)
    monkeypatch.setattr(deciding, "light_places", lambda *_: places)
    correct_final_scale(Subject(run.plan, model, solver, said.append, run.pixels, 0), step=12)
    assert len(said) == 1
    assert f"mean base colour {1.3 * BASE_COLOR:.2f} → " in said[0]
    assert model.brdf.base_color_scale.item() == pytest.approx(1 / 1.3, rel=0.06)


def test_without_highlights_the_scale_is_not_corrected(
    capture: Path,
    tmp_path: Path,
    monkeypatch,
    places: Places,  # noqa: F811
) -> None:
    """Diffuse reflection alone does not reveal it."""
    run, said = small_training(capture, tmp_path, small_config()), []
    model, solver = mis_scaled(1.3, places)
    model.lobe = None
    monkeypatch.setattr(deciding, "light_places", lambda *_: places)
    correct_final_scale(Subject(run.plan, model, solver, said.append, run.pixels, 0), step=12)
    assert said == []
    assert model.brdf.base_color_scale.item() == 1
