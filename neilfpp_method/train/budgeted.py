"""A training for a time: tried out and planned before it begins, and what came of it."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path

import torch

from neilfpp_method.budget.durations import in_words
from neilfpp_method.budget.plan import MIN_SHARE, share_for, smallest_budget, steps_for
from neilfpp_method.budget.sizes import Size, next_size, sized
from neilfpp_method.data.capture import Capture
from neilfpp_method.effects.asked import Asked
from neilfpp_method.effects.material import JUDGED
from neilfpp_method.effects.plan import Decision, Plan
from neilfpp_method.errors import UserError
from neilfpp_method.settings.types import NeilfConfig
from neilfpp_method.timing.ledger import Ledger
from neilfpp_method.train.budget_record import BudgetPlan, Revision, write_budget
from neilfpp_method.train.pace import with_steps
from neilfpp_method.train.quality import Look
from neilfpp_method.train.trial import Trial, try_out
from neilfpp_method.train.work_record import waiting

__all__ = ["close_budget", "outcome", "plan_budget", "planned_effects", "planned_settings"]

TRIAL_SHARE, MAX_TRIAL = 0.03, 10.0
"""Of the budget, and seconds, that the steps of a trial may take, about."""
PLACES_SHARE = 0.1
"""Of the budget that looks at places may take; else materials and light are as the settings have them."""
LIGHT_SHARE = 0.2
"""Share of the budget that the search for the initial light may take; for more it uses fewer places."""
LONG_TAILS = "long-tails"
"""The effect that the search for the initial light decides."""


def plan_budget(
    budget: float,
    capture: Capture,
    config: NeilfConfig,
    asked: Asked,
    device: torch.device,
    devices: int,
    ledger: Ledger,
    report: bool,
    say: Callable[[str], object],
) -> BudgetPlan:
    """Try out what a training costs, and plan one for the time.

    Args:
        budget: seconds of all that `ledger` counts.
        capture: whose views are as large as their files.
        config: the settings; the steps of its stages are proportions.
        asked: which effects are simulated.
        device, devices: where to compute, and how many processes shall.
        ledger: what has passed so far is part of the budget.
        report: whether the run will end with its page.
        say: tells a person the plan.

    Raises:
        UserError: the budget is too small, and the smallest that makes sense is named; or several processes
            are asked for.
    """
    if devices > 1:
        raise UserError("--budget plans for one process", "leave --devices and --nodes out")
    wait = waiting(device) or (lambda: None)
    trials: dict[Size, Trial] = {}

    def share(size: Size) -> float:
        if size not in trials:
            limit = min(TRIAL_SHARE * budget, MAX_TRIAL)
            changed = sized(config, size)
            places, light = PLACES_SHARE * budget, LIGHT_SHARE * budget
            trials[size] = try_out(capture, changed, asked, device, limit, places, light, report, wait)
        return share_for(trials[size].costs, budget, ledger.total)

    size: Size = "usual"
    tried = next_size(share("usual"))
    if tried == "small" or (tried == "large" and share("large") >= 1.0):
        size = tried
    found, trial = share(size), trials[size]
    if found < MIN_SHARE:
        needed = smallest_budget(trial.costs, ledger.total)
        raise UserError(
            f"a budget of {in_words(budget)} is too small: {in_words(ledger.total)} of it are over, and "
            f"{in_words(trial.costs.once)} go to what does not depend on the number of steps",
            f"the smallest that makes sense on this machine, as it is now, is --budget {in_words(needed)}",
        )
    plan = BudgetPlan(budget, size, trial.costs, trial.places > 0.0, trial.light_pixels)
    plan.revisions.append(Revision(ledger.total, 0, steps_for(trial.costs, found)))
    say(_in_words(plan))
    return plan


def planned_settings(plan: BudgetPlan, config: NeilfConfig) -> NeilfConfig:
    """The settings of the run."""
    config = sized(config, plan.size)
    return replace(config, train=with_steps(config.train, plan.steps))


def planned_effects(plan: BudgetPlan, effects: Plan) -> None:
    """What the budget decides of the effects: whether there is time to look at places."""
    reason = f"evidence would take more than {PLACES_SHARE:.0%} of the budget"
    for name in JUDGED:
        if effects.is_open(name) and not plan.places_looked_at:
            effects.decisions.append(Decision(0, name, effects.is_on(name), "settings", reason))
    if effects.is_open(LONG_TAILS) and plan.light_pixels == 0:
        reason = f"evidence would take more than {LIGHT_SHARE:.0%} of the budget"
        effects.decisions.append(Decision(0, LONG_TAILS, effects.is_on(LONG_TAILS), "settings", reason))


def _in_words(plan: BudgetPlan) -> str:
    """For people, before the training."""
    steps = ", ".join(f"{stage.replace('_', ' ')} {count}" for stage, count in plan.steps.items())
    return (
        f"budget {in_words(plan.budget)}: steps planned: {steps}; steps of {plan.size} size; "
        f"{in_words(plan.costs.once)} go to looks, pictures and the report. How accurate it will be is not "
        "known before"
    )


def close_budget(run: Path, plan: BudgetPlan, seconds: float) -> None:
    """Note what a run took that has come to its end."""
    plan.took = seconds
    write_budget(run, plan)


def outcome(plan: BudgetPlan, looks: Sequence[Look]) -> str:
    """For people, at the very end: how close the clock came, and what came of it."""
    seconds = plan.took or 0.0
    off = f"{100.0 * (seconds / plan.budget - 1.0):+.1f} %".replace("-", "\N{MINUS SIGN}")
    steps = ", ".join(f"{stage.replace('_', ' ')} {count}" for stage, count in plan.steps.items())
    text = f"budget: {seconds:.1f} s of {plan.budget:.0f} s ({off}); steps: {steps}"
    if looks:
        last = looks[-1]
        physical = "" if last.physical is None else f", PBR {last.physical:.1f} dB"
        text += f"; pixels held back: R {last.radiance:.1f} dB{physical}"
    return text
