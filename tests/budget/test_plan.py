"""The arithmetic of a time budget, on simulated trainings with a simulated clock."""

from __future__ import annotations

from collections.abc import Callable

import pytest

from neilfpp_method.budget.durations import format_duration, read_duration
from neilfpp_method.budget.plan import (
    MAX_SHARE,
    MIN_SHARE,
    Costs,
    Progress,
    StageCost,
    revised_steps,
    share_for,
    smallest_budget,
    steps_for,
)
from neilfpp_method.budget.sizes import next_size, sized
from neilfpp_method.errors import UserError
from neilfpp_method.settings.presets import fixed_geometry, free_light, preset
from neilfpp_method.settings.types import NeilfConfig

COSTS = Costs(
    {
        "sdf_init": StageCost(steps=2000, step=0.05, end=3.0),
        "material_init": StageCost(steps=1500, step=0.08, fit=0.02, start=2.0, end=4.0, first_fit=4.0),
        "joint": StageCost(steps=100, step=0.2, fit=0.02, end=4.0),
    },
    reserve=10.0,
)


# ---------------------------------------------------------------------------------------------- at the start


def test_a_plan_uses_up_the_budget():
    # once: 3 + 6 + 4 + 4 + 10 = 27; steps: 2000·0.05 + 1500·0.1 + 100·0.22 = 272
    assert COSTS.once == pytest.approx(27.0)
    assert COSTS.all_steps == pytest.approx(272.0)
    share = share_for(COSTS, budget=27.0 + 5.0 + 136.0, spent=5.0)
    assert share == pytest.approx(0.5)
    assert steps_for(COSTS, share) == {"sdf_init": 1000, "material_init": 750, "joint": 50}


def test_a_budget_beyond_the_largest_share_is_not_used_up():
    assert share_for(COSTS, budget=1e6, spent=0.0) == MAX_SHARE


def test_every_stage_has_a_step():
    assert steps_for(COSTS, 0.001)["joint"] == 1


def test_the_smallest_budget_is_enough_and_a_round_number():
    for spent in (0.0, 7.3, 200.0):
        smallest = smallest_budget(COSTS, spent)
        assert share_for(COSTS, smallest, spent) >= MIN_SHARE
        assert smallest % 5 == 0
    needed = 27.0 + 27.2
    assert smallest_budget(COSTS, 0.0) == 65.0  # 1.15 · 54.2 = 62.3
    assert share_for(COSTS, needed - 1.0, 0.0) < MIN_SHARE


# ------------------------------------------------------------------------------------------- while it trains


def simulate(
    budget: float, slower: Callable[[float], float], spent: float = 5.0, every: float = 0.02
) -> tuple[float, dict[str, int], list[dict[str, int]]]:
    """Simulate a training whose costs are `COSTS` times `slower`, a function of the elapsed time, with a fit
    every 100 steps. Returns its seconds, the steps of each stage, and the plans.
    """
    now = spent
    planned = steps_for(COSTS, share_for(COSTS, budget, now))
    plans, last, done = [planned], now, {}
    for stage, cost in COSTS.stages.items():
        stepping = fitting = 0.0
        number = 0
        now += cost.start * slower(now)
        while number < planned[stage]:
            if number == 3:
                first = cost.first_fit * slower(now)
                fitting, now = fitting + first, now + first
            taken = cost.step * slower(now)
            stepping, now = stepping + taken, now + taken
            if number % 100 == 99:
                fit = 100 * cost.fit * slower(now)
                fitting, now = fitting + fit, now + fit
            number += 1
            if now - last >= every * budget:
                at = Progress(stage, number, now, stepping, fitting)
                planned, last = revised_steps(COSTS, planned, at, budget), now
                plans.append(planned)
        done[stage] = number
        now += cost.end * slower(now)
    return now + COSTS.reserve * slower(now), done, plans


@pytest.mark.parametrize("budget", [90.0, 150.0, 300.0, 900.0])
@pytest.mark.parametrize("factor", [0.7, 1.0, 1.6])
def test_a_machine_slower_or_faster_than_in_the_trial(budget, factor):
    """The budget is kept within a tenth if the work at the end is slower than in the trial by the same
    factor.
    """
    seconds, done, _ = simulate(budget, lambda now: factor)
    assert seconds == pytest.approx(budget, rel=0.1)
    assert min(done.values()) >= 1


def test_a_machine_as_fast_as_in_the_trial_needs_no_new_plan():
    seconds, done, plans = simulate(300.0, lambda now: 1.0)
    assert seconds == pytest.approx(300.0, rel=0.02)
    for stage in ("sdf_init", "material_init"):
        assert done[stage] == pytest.approx(plans[0][stage], rel=0.05, abs=2)
    # The plan has a share of a fit, 2 s, for the 99 steps of the last stage, and none comes within them.
    assert plans[0]["joint"] <= done["joint"] <= 1.2 * plans[0]["joint"]


def test_other_programs_start_and_end():
    seconds, _, _ = simulate(300.0, lambda now: 2.0 if 60.0 < now < 160.0 else 1.0)
    assert seconds == pytest.approx(300.0, rel=0.05)


def test_without_revisions_a_slow_machine_exceeds_the_budget():
    """The purpose of the revisions: the same machine with a single plan."""
    seconds, _, _ = simulate(300.0, lambda now: 1.6, every=10.0)
    assert seconds > 1.3 * 300.0


def test_when_the_time_is_used_up_the_stage_ends_and_later_ones_get_one_step():
    planned = {"sdf_init": 100, "material_init": 75, "joint": 5}
    late = Progress("sdf_init", 60, seconds=500.0, stepping=3.0, fitting=0.0)
    assert revised_steps(COSTS, planned, late, budget=90.0) == {
        "sdf_init": 60,
        "material_init": 1,
        "joint": 1,
    }


def test_finished_stages_are_unchanged():
    planned = {"sdf_init": 321, "material_init": 75, "joint": 5}
    at = Progress("material_init", 10, seconds=50.0, stepping=0.8, fitting=6.0)
    assert revised_steps(COSTS, planned, at, budget=500.0)["sdf_init"] == 321


def test_a_plan_has_at_least_the_trained_steps_and_at_most_the_largest_share():
    planned = {"sdf_init": 100, "material_init": 75, "joint": 5}
    for seconds in (0.0, 1e9):
        at = Progress("joint", 5, seconds, stepping=1.0, fitting=0.0)
        assert 5 <= revised_steps(COSTS, planned, at, budget=1e6)["joint"] <= MAX_SHARE * 100


# ----------------------------------------------------------------------------------------------------- sizes


@pytest.mark.parametrize(
    "config",
    [preset("fast"), fixed_geometry(preset("fast")), free_light(preset("fast")), preset("paper-ngp")],
    ids=["fast", "mesh", "free", "paper"],
)
def test_sizes_change_only_the_size_of_a_step(config: NeilfConfig):
    small, large = sized(config, "small"), sized(config, "large")
    assert sized(config, "usual") == config
    assert 2 * small.train.rays == config.train.rays == large.train.rays // 2
    assert small.shading.train_samples < config.shading.train_samples < large.shading.train_samples
    assert small.train.sdf_steps == config.train.sdf_steps == large.train.sdf_steps
    assert small.optimizer == config.optimizer


def test_a_size_follows_from_the_steps_that_fit():
    assert [next_size(share) for share in (-1.0, 0.2, 0.3, 1.9, 8.0)] == [
        "small",
        "small",
        "usual",
        "usual",
        "large",
    ]


# ----------------------------------------------------------------------------------------------------- times


@pytest.mark.parametrize(
    ("text", "seconds"), [("90s", 90), ("10m", 600), ("1h", 3600), ("1.5m", 90), ("1h2m3s", 3723)]
)
def test_durations_are_parsed(text, seconds):
    assert read_duration(text) == seconds


@pytest.mark.parametrize(
    "text", ["", "10", "ten", "-5m", "5 minutes", "0s", "1e3s", "99999h", "5m10", "nan s"]
)
def test_invalid_durations_are_refused(text):
    with pytest.raises(UserError, match=r"not a duration|out of range"):
        read_duration(text)


@pytest.mark.parametrize("seconds", [1, 59, 60, 61, 600, 3540, 3600, 5400, 86_400])
def test_formatted_durations_are_parsed_back(seconds):
    assert read_duration(format_duration(float(seconds))) == seconds
