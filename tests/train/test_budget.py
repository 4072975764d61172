"""Training for a time budget: trial, plan, revisions by a clock, continuation, and refusal of budgets that
are too small.
"""

from __future__ import annotations

import itertools
import json
from pathlib import Path

import pytest
import torch
from rich.console import Console

from neilfpp_method.budget.plan import Costs, StageCost
from neilfpp_method.cli import main
from neilfpp_method.data.capture import Capture, load_capture
from neilfpp_method.effects.plan import Plan
from neilfpp_method.effects.request import EffectRequest, parse_effects
from neilfpp_method.effects.review import MAX_PIXELS, review_light
from neilfpp_method.errors import Stopped, UserError
from neilfpp_method.settings.presets import PRESETS
from neilfpp_method.settings.types import NeilfConfig
from neilfpp_method.timing.ledger import Ledger
from neilfpp_method.train import budgeted, command
from neilfpp_method.train.budget_record import BudgetPlan, read_budget
from neilfpp_method.train.budgeted import BudgetTooSmall, plan_budget, planned_effects
from neilfpp_method.train.checkpoint import last_checkpoint, load_checkpoint
from neilfpp_method.train.command import run_training
from neilfpp_method.train.request import TrainingRequest
from neilfpp_method.train.run import load_run
from neilfpp_method.train.trial import Trial, TrialLimits, TrialTooLong, Workload, run_trial
from tests.data.make_capture import make_capture
from tests.train.small_runs import small_config, small_training, solved_light
from tests.train.test_resume import interrupt_at

STEPS = {"sdf_steps": 40, "material_steps": 40, "joint_steps": 20}
TICK = 0.1
"""Seconds that pass at every look at the clock: some two seconds a step."""


@pytest.fixture
def clock(monkeypatch: pytest.MonkeyPatch) -> None:
    """A ledger whose clock advances at every reading, and a trial in which steps cost half as much."""

    def ticking(synchronize: object = None) -> Ledger:
        ticks = itertools.count()
        return Ledger(now=lambda: TICK * next(ticks))

    cost = {"step": 1.0, "start": 0.5, "end": 1.0}
    stages = {name.replace("steps", "init").replace("joint_init", "joint"): n for name, n in STEPS.items()}
    costs = Costs({stage: StageCost(steps=n, **cost) for stage, n in stages.items()}, reserve=0.0)
    monkeypatch.setattr(command, "Ledger", ticking)
    monkeypatch.setattr(budgeted, "run_trial", lambda *_: Trial(costs, places=0.0, light_pixels=0))


def run(data: Path | None, out: Path, resume: bool = False, **options) -> str:
    console = Console()
    config = None if resume else small_config(**STEPS)
    with console.capture() as said:
        run_training(TrainingRequest(data, out, config, resume, device="cpu", **options), console)
    return said.get()


def workload(capture: Capture, config: NeilfConfig, base: str, report: bool = False) -> Workload:
    return Workload(capture, config, EffectRequest(base), torch.device("cpu"), report)


def trained_steps(out: Path) -> int:
    return load_checkpoint(last_checkpoint(out))["step"]


def test_a_run_keeps_its_budget_although_steps_are_slower_than_in_the_trial(tmp_path, capture, clock):
    said = run(capture, tmp_path / "run", budget=120.0, effects=parse_effects("auto"))
    plan = read_budget(tmp_path / "run")
    assert plan.took == pytest.approx(120.0, rel=0.1)
    first, last = plan.revisions[0], plan.revisions[-1]
    assert len(plan.revisions) > 3
    assert sum(last.steps.values()) < 0.8 * sum(first.steps.values())  # as many as the trial promised
    assert trained_steps(tmp_path / "run") == sum(last.steps.values())

    # The loaded run has the steps that were trained, and a material.
    loaded = load_run(tmp_path / "run")
    assert loaded.config.train.sdf_steps == last.steps["sdf_init"]
    assert loaded.config.train.joint_steps == last.steps["joint"]
    assert loaded.has_material
    assert "budget 2m: measuring a few steps of each stage" in said
    assert "budget 2m: planned steps: sdf init" in said
    assert "expected accuracy" in said
    assert f"budget: {plan.took:.1f} s of 120 s" in said

    # The trial found no time for evidence for metals, so there may be metals.
    decisions = json.loads((tmp_path / "run" / "effects.json").read_text())["decisions"]
    metals = [decision for decision in decisions if decision["effect"] == "metals"]
    assert [(decision["on"], decision["by"]) for decision in metals] == [(True, "settings")]


def test_a_stopped_run_continues_within_its_budget(tmp_path, capture, clock):
    out = tmp_path / "run"
    with pytest.MonkeyPatch.context() as patch:
        interrupt_at(patch, 12)
        with pytest.raises(Stopped):
            run(capture, out, budget=120.0)
    before = read_budget(out)
    assert before.took is None
    with pytest.raises(UserError, match="the run has a budget of 2m"):
        run(None, out, resume=True, budget=60.0)
    run(None, out, resume=True)
    after = read_budget(out)
    assert after.revisions[: len(before.revisions)] == before.revisions
    assert after.took == pytest.approx(120.0, rel=0.1)
    assert trained_steps(out) == sum(after.steps.values())


def test_a_budget_too_small_is_refused_with_the_smallest_one(tmp_path, capture, clock, monkeypatch, capsys):
    monkeypatch.setitem(PRESETS, "tiny", lambda: small_config(**STEPS))
    words = ["train", "--data", str(capture), "--preset", "tiny", "--device", "cpu", "--no-report"]
    assert main([*words, "--out", str(tmp_path / "run"), "--budget", "10s"]) == 2
    complaint = capsys.readouterr().err
    assert "a budget of 10s is too small" in complaint
    assert not (tmp_path / "run").exists()
    smallest = complaint.split("--budget ")[1].strip()
    assert main([*words, "--out", str(tmp_path / "run"), "--budget", smallest]) == 0
    assert main([*words, "--out", str(tmp_path / "other"), "--budget", "ten"]) == 2
    assert not (tmp_path / "other").exists()


def test_a_budget_that_passes_during_the_first_trial_is_refused_at_once(capture):
    """The clock passes the budget in the first stage; neither later stages nor another size are measured."""
    ticks = itertools.count()
    work = workload(load_capture(capture), solved_light(small_config()), "as-set")
    with pytest.raises(BudgetTooSmall, match=r"5s is too small: it has passed .* --budget 25s") as refused:
        plan_budget(5.0, work, Ledger(now=lambda: 1.0 * next(ticks)))
    assert next(ticks) < 10  # looks at the clock; a stage takes at least six steps
    assert refused.value.needed == 5.0


def test_a_budget_that_passes_during_the_second_trial_names_the_smallest_of_the_first(
    capture, clock, monkeypatch
):
    trials = []

    def run_once(work: Workload, limits: TrialLimits) -> Trial:
        trials.append(work)
        if len(trials) == 2:
            raise TrialTooLong
        return Trial(Costs({"joint": StageCost(100, 1.0, end=2.0)}), places=0.0, light_pixels=0)

    monkeypatch.setattr(budgeted, "run_trial", run_once)
    work = workload(load_capture(capture), small_config(), "as-set")
    with pytest.raises(BudgetTooSmall, match=r"the smallest usable budget .* --budget 15s") as refused:
        plan_budget(11.0, work, Ledger(now=lambda: 0.0))
    assert refused.value.needed == pytest.approx(2.0 + 0.1 * 100)
    assert len(trials) == 2


def test_a_budget_with_several_processes_is_refused(tmp_path, capture, clock):
    with pytest.raises(UserError, match="--budget plans for one process"):
        run(capture, tmp_path / "run", budget=120.0, devices=2)


def test_a_run_without_a_budget_has_no_plan(tmp_path, capture, clock):
    with pytest.MonkeyPatch.context() as patch:
        interrupt_at(patch, 2)
        with pytest.raises(Stopped):
            run(capture, tmp_path / "run")
    assert read_budget(tmp_path / "run") is None
    with pytest.raises(UserError, match="the run has no budget"):
        run(None, tmp_path / "run", resume=True, budget=60.0)


def test_a_trial_measures_every_stage_that_has_steps(capture):
    config = solved_light(small_config(sdf_steps=100, material_steps=0, joint_steps=50))
    trial = run_trial(
        workload(load_capture(capture), config, "auto", report=True), TrialLimits(0.2, 1e9, 1e9)
    )
    costs = trial.costs
    assert {stage: cost.steps for stage, cost in costs.stages.items()} == {"sdf_init": 100, "joint": 50}
    assert all(cost.step > 0 and cost.end > 0 for cost in costs.stages.values())
    assert costs.stages["sdf_init"].fit == costs.stages["sdf_init"].start == 0.0
    assert costs.stages["joint"].fit > 0
    assert costs.stages["joint"].first_fit > 0
    assert costs.stages["joint"].start > trial.places > 0  # evidence at the surface and at places
    assert costs.reserve > 0


def test_evidence_that_takes_too_long_is_not_measured(capture):
    config = solved_light(small_config(sdf_steps=0))
    trial = run_trial(workload(load_capture(capture), config, "auto"), TrialLimits(0.05, 1e-9, 1e-9))
    assert trial.places == 0.0
    assert list(trial.costs.stages) == ["material_init", "joint"]
    assert trial.costs.stages["joint"].first_fit == 0.0  # it is in the previous stage


def test_the_initial_light_is_planned_with_as_many_pixels_as_the_time_permits(tmp_path):
    config = solved_light(small_config(sdf_steps=10))
    many = load_capture(make_capture(tmp_path / "many", views=9))

    def trial(most_for_light: float) -> Trial:
        return run_trial(workload(many, config, "auto"), TrialLimits(0.05, 1e-9, most_for_light))

    whole = trial(1e9)
    assert whole.light_pixels == MAX_PIXELS
    first, later = whole.costs.stages["material_init"], whole.costs.stages["joint"]
    assert first.first_fit == 0.0  # it is part of the search
    assert first.start > 100 * later.start
    none = trial(1e-9)
    assert none.light_pixels == 0
    assert none.costs.stages["material_init"].first_fit > 0.0


def test_without_time_for_the_initial_light_training_starts_from_an_even_one(tmp_path):
    capture = make_capture(tmp_path / "many", views=9)
    training = small_training(capture, tmp_path / "run", solved_light(small_config(sdf_steps=0)))
    plan = Plan.begin(parse_effects("auto"), training.config)
    review = review_light(plan, training.model, training.pixels, 0, max_pixels=0)
    assert review.first is None
    assert {(decision.effect, decision.on) for decision in review.decisions} == {
        ("long-tails", True),
        ("metals", True),
    }
    assert all("the budget leaves no time for it" in decision.reason for decision in review.decisions)
    planned = BudgetPlan(60.0, "usual", Costs({}), places_looked_at=True, light_pixels=0)
    planned_effects(planned, plan)
    assert "20% of the budget" in plan.newest("long-tails").reason


def test_effects_that_settings_decide_are_not_measured_in_a_trial(capture):
    config = small_config(joint_steps=0)
    trial = run_trial(workload(load_capture(capture), config, "as-set"), TrialLimits(0.05, 1.0, 1.0))
    assert list(trial.costs.stages) == ["sdf_init", "material_init"]
    assert trial.costs.stages["material_init"].fit == 0.0  # a free light is not fitted
    assert trial.costs.reserve == trial.places == 0.0
    assert trial.light_pixels is None


@pytest.mark.parametrize(
    "damage",
    [
        {"format": 9},
        {"revisions": []},
        {"budget": None},
        {"size": "huge"},
        {"light_pixels": -1},
        {"costs": {"stages": {"joint": {"steps": 1}}, "reserve": 0}},
        {"revisions": [{"seconds": 1, "step": 0, "steps": {"tea": 3}}]},
        {"revisions": [{"seconds": 1, "step": 0, "steps": {"joint": -3}}]},
        {"costs": 7},
    ],
)
def test_a_damaged_plan_is_named(tmp_path, damage):
    cost = {"steps": 10, "step": 0.1, "fit": 0.0, "start": 0.0, "end": 0.0}
    good = {
        "format": 1,
        "budget": 60.0,
        "size": "usual",
        "costs": {"stages": {"joint": cost}, "reserve": 1.0},
        "places_looked_at": True,
        "revisions": [{"seconds": 1.0, "step": 0, "steps": {"joint": 10}}],
        "took": None,
    }
    (tmp_path / "plan.json").write_text(json.dumps(good))
    assert read_budget(tmp_path).steps == {"joint": 10}
    (tmp_path / "plan.json").write_text(json.dumps(good | damage))
    with pytest.raises(UserError, match=r"plan\.json"):
        read_budget(tmp_path)
