"""Plan a training for a time budget, and report the outcome."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

from neilfpp_method.budget.durations import format_duration
from neilfpp_method.budget.expected import described
from neilfpp_method.budget.plan import MIN_SHARE, share_for, smallest_budget, steps_for
from neilfpp_method.budget.sizes import Size, next_size, sized
from neilfpp_method.effects.evidence.material import EFFECTS_AT_PLACES
from neilfpp_method.effects.plan import Decision, Plan
from neilfpp_method.errors import UserError
from neilfpp_method.settings.types import NeilfConfig
from neilfpp_method.timing.ledger import Ledger
from neilfpp_method.train.budget_record import BudgetPlan, Revision, write_budget
from neilfpp_method.train.pace import with_steps
from neilfpp_method.train.quality import QualityCheck
from neilfpp_method.train.trial import Trial, TrialLimits, TrialTooLong, Workload, run_trial

__all__ = [
    "BudgetTooSmall",
    "close_budget",
    "outcome",
    "plan_budget",
    "plan_summary",
    "planned_effects",
    "planned_settings",
]

TRIAL_SHARE = 0.03
"""Share of the budget that the steps of a trial may take."""
MAX_TRIAL = 10.0
"""Maximum time that the steps of a trial may take, in seconds."""
PLACES_SHARE = 0.1
"""Share of the budget that measurements at places may take. If they take more they are left out, and the
effects that they would decide stay as in the settings.
"""
LIGHT_SHARE = 0.2
"""Share of the budget that the search for the initial light may take; it uses as many places as fit."""
GUESSED_BUDGET = 5
"""Ratio of the proposed budget to one that passed before the first trial was finished."""
LONG_TAILS = "long-tails"
"""The effect that is decided together with the initial light."""


class BudgetTooSmall(UserError):
    """A budget is too small for this machine.

    Args:
        problem, remedy: as for `UserError`.
        needed: seconds of the smallest useful training, without the trial. All budgets below it are too
            small, since a larger budget has no less work that is independent of the number of steps.
    """

    def __init__(self, problem: str, remedy: str, needed: float) -> None:
        super().__init__(problem, remedy)
        self.needed = needed


def plan_budget(budget: float, work: Workload, ledger: Ledger) -> BudgetPlan:
    """Measure the costs of a training in a trial, and plan its steps for a time budget.

    Args:
        budget: time of the whole command, in seconds.
        work: the training, with views of the size of their files; the steps of its stages are used as
            proportions.
        ledger: the clock; time that has already passed is part of the budget.

    Raises:
        BudgetTooSmall: the message names the smallest usable budget. If the trial takes longer than the
            budget, it ends at once.
    """
    limits = TrialLimits(
        steps=min(TRIAL_SHARE * budget, MAX_TRIAL),
        places=PLACES_SHARE * budget,
        light=LIGHT_SHARE * budget,
        has_time=lambda: ledger.total < budget,
    )
    trials: dict[Size, Trial] = {}

    def share(size: Size) -> float:
        if size not in trials:
            trials[size] = run_trial(replace(work, config=sized(work.config, size)), limits)
        return share_for(trials[size].costs, budget, ledger.total)

    size: Size = "usual"
    try:
        candidate = next_size(share("usual"))
        if candidate == "small" or (candidate == "large" and share("large") >= 1.0):
            size = candidate
        affordable, trial = share(size), trials[size]
    except TrialTooLong:
        raise _too_small(budget, trials.get("usual"), ledger.total) from None
    if affordable < MIN_SHARE:
        raise _too_small(budget, trial, ledger.total)
    plan = BudgetPlan(budget, size, trial.costs, trial.places > 0.0, trial.light_pixels)
    plan.revisions.append(Revision(ledger.total, 0, steps_for(trial.costs, affordable)))
    return plan


def _too_small(budget: float, trial: Trial | None, spent: float) -> BudgetTooSmall:
    """The error for a budget, from a finished trial, or from none if the budget passed during the first."""
    problem = f"a budget of {format_duration(budget)} is too small: "
    if trial is None:
        guess = format_duration(GUESSED_BUDGET * budget)
        return BudgetTooSmall(
            problem + "it has passed while the time of a few steps was measured",
            f"give several times as much, such as --budget {guess}, or end other programs",
            budget,
        )
    return BudgetTooSmall(
        f"{problem}{format_duration(spent)} of it have passed, and {format_duration(trial.costs.once)} are "
        "needed for work that does not depend on the number of steps",
        "the smallest usable budget on this machine at its present load is --budget "
        f"{format_duration(smallest_budget(trial.costs, spent))}",
        trial.costs.once + MIN_SHARE * trial.costs.all_steps,
    )


def planned_settings(plan: BudgetPlan, config: NeilfConfig) -> NeilfConfig:
    """The settings with the planned size and number of steps."""
    config = sized(config, plan.size)
    return replace(config, train=with_steps(config.train, plan.steps))


def planned_effects(plan: BudgetPlan, effects: Plan) -> None:
    """Leave the effects that are measured at places as in the settings if there is no time to measure."""
    reason = f"not measured: that would take more than {PLACES_SHARE:.0%} of the budget"
    for name in EFFECTS_AT_PLACES:
        if effects.is_open(name) and not plan.places_looked_at:
            effects.decisions.append(Decision(0, name, effects.is_on(name), "settings", reason))
    if effects.is_open(LONG_TAILS) and plan.light_pixels == 0:
        reason = f"evidence would take more than {LIGHT_SHARE:.0%} of the budget"
        effects.decisions.append(Decision(0, LONG_TAILS, effects.is_on(LONG_TAILS), "settings", reason))


def plan_summary(plan: BudgetPlan, finds_geometry: bool) -> str:
    """One line for the console, before the training: the planned steps, and what accuracy to expect."""
    share = sum(plan.steps.values()) / sum(cost.steps for cost in plan.costs.stages.values())
    steps = ", ".join(f"{stage.replace('_', ' ')} {count}" for stage, count in plan.steps.items())
    accuracy = "the accuracy of short trainings with a given mesh was not measured"
    return (
        f"budget {format_duration(plan.budget)}: planned steps: {steps}; step size: {plan.size}; "
        f"{format_duration(plan.costs.once)} for measurements, previews and the report; "
        f"{described(share) if finds_geometry else accuracy}"
    )


def close_budget(run: Path, plan: BudgetPlan, seconds: float) -> None:
    """Record the time that a finished run has taken."""
    plan.took = seconds
    write_budget(run, plan)


def outcome(plan: BudgetPlan, checks: Sequence[QualityCheck]) -> str:
    """One line for the console at the end: time taken against the budget, steps, and accuracy."""
    seconds = plan.took or 0.0
    deviation = f"{100.0 * (seconds / plan.budget - 1.0):+.1f} %".replace("-", "\N{MINUS SIGN}")
    steps = ", ".join(f"{stage.replace('_', ' ')} {count}" for stage, count in plan.steps.items())
    text = f"budget: {seconds:.1f} s of {plan.budget:.0f} s ({deviation}); steps: {steps}"
    if checks:
        last = checks[-1]
        physical = "" if last.physical is None else f", PBR {last.physical:.1f} dB"
        text += f"; PSNR of held-back pixels: R {last.radiance:.1f} dB{physical}"
    return text
