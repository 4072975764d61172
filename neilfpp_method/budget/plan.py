"""Compute how many steps of each stage fit into a time budget.

The time of a stage consists of its steps, each with its part of the fits of the light, and of work that is
done once at its start and its end. The stages keep the proportions of the settings. A common factor on their
steps, the `share`, follows from

    share · Σ steps · (step + fit) = budget − spent − Σ once − reserve

The first plan uses the costs that a trial measured. During the run the equation is solved again for the
remaining steps, with the times measured so far.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass

__all__ = [
    "MAX_SHARE",
    "MIN_SHARE",
    "Costs",
    "Progress",
    "StageCost",
    "revised_steps",
    "share_for",
    "smallest_budget",
    "steps_for",
]

MIN_SHARE = 0.1
"""Smallest useful share of the steps of the settings. With this share, `fast` trains the distance field for
400 steps and fits the light once; fewer give no recognisable result.
"""
MAX_SHARE = 8.0
"""Largest share of the steps of the settings. The effect of more steps was not measured."""
TRUSTED_STEPS = 40
"""Weight of the trial's measurement in the mean time of a step, in steps of the run."""
SPARE_FACTOR = 1.15
"""Safety factor of the smallest budget that an error message names, because a trial is not exact."""


@dataclass(frozen=True)
class StageCost:
    """The costs of a stage, in seconds.

    Attributes:
        steps: number of steps in the settings, which defines the proportions of the stages.
        step: time of a step.
        fit: time of the fits of the light per step, without the first fit of the run.
        start: time of the work before its first step: evidence for effects.
        first_fit: time of the first fit of the light in the run, which takes longer than later ones; 0 in
            other stages.
        end: time of the work at its end: preview, measurements, checkpoint.
    """

    steps: int
    step: float
    fit: float = 0.0
    start: float = 0.0
    end: float = 0.0
    first_fit: float = 0.0

    @property
    def once(self) -> float:
        """Time that does not depend on the number of steps."""
        return self.start + self.first_fit + self.end


@dataclass(frozen=True)
class Costs:
    """The costs of a training, in seconds.

    Attributes:
        stages: costs of the stages in order; stages without steps are left out.
        reserve: time of the report after training.
    """

    stages: Mapping[str, StageCost]
    reserve: float = 0.0

    @property
    def once(self) -> float:
        """Time that does not depend on the number of steps."""
        return self.reserve + sum(cost.once for cost in self.stages.values())

    @property
    def all_steps(self) -> float:
        """Time of all steps of the settings."""
        return sum(cost.steps * (cost.step + cost.fit) for cost in self.stages.values())


@dataclass(frozen=True)
class Progress:
    """The state of a run.

    Attributes:
        stage: the current stage.
        step: number of steps of this stage trained so far.
        seconds: time of the run so far.
        stepping: time of the steps of this stage so far, without fits of the light.
        fitting: time of the fits of the light in this stage so far.
    """

    stage: str
    step: int
    seconds: float
    stepping: float
    fitting: float


def share_for(costs: Costs, budget: float, spent: float) -> float:
    """The factor on the steps of the settings that uses up the budget, at most `MAX_SHARE`.

    If it is below `MIN_SHARE`, the budget is too small.

    Args:
        costs: the costs of the training.
        budget: the budget, in seconds.
        spent: time that has passed, in seconds.

    >>> share_for(Costs({"joint": StageCost(steps=100, step=0.5, end=10.0)}, reserve=5.0), 50.0, 10.0)
    0.5
    """
    return min((budget - spent - costs.once) / max(costs.all_steps, 1e-9), MAX_SHARE)


def steps_for(costs: Costs, share: float) -> dict[str, int]:
    """Steps of each stage for a share, at least one."""
    return {stage: max(1, round(share * cost.steps)) for stage, cost in costs.stages.items()}


def smallest_budget(costs: Costs, spent: float) -> float:
    """The smallest useful budget in seconds, rounded up to 5 s, or to 30 s from 3 minutes on."""
    needed = SPARE_FACTOR * (spent + costs.once + MIN_SHARE * costs.all_steps)
    unit = 5.0 if needed <= 180.0 else 30.0
    return unit * math.ceil(needed / unit)


def revised_steps(costs: Costs, planned: Mapping[str, int], at: Progress, budget: float) -> dict[str, int]:
    """Plan the remaining steps of a run again from measured times.

    Finished stages are left unchanged. In the current stage, the time of a step is the mean over its steps so
    far and `TRUSTED_STEPS` of the trial. Later stages are assumed to deviate from the trial by the same
    factor. If no time is left, the current stage ends at once and each later stage gets one step.

    Args:
        costs: the costs that the trial measured.
        planned: steps of each stage in the current plan.
        at: the state of the run.
        budget: the budget, in seconds.

    Returns:
        The steps of each stage in the new plan.
    """
    order = list(costs.stages)
    later = order[order.index(at.stage) + 1 :]
    here = costs.stages[at.stage]
    trusted = TRUSTED_STEPS + at.step
    step = (TRUSTED_STEPS * here.step + at.stepping) / trusted
    fits = max(0.0, at.fitting - here.first_fit)
    fit = (TRUSTED_STEPS * here.fit + fits) / trusted
    slower = step / here.step if here.step > 0 else 1.0

    once = costs.reserve + here.end + (0.0 if at.fitting else here.first_fit)
    once += slower * sum(costs.stages[name].once for name in later)
    left = {at.stage: max(planned[at.stage] - at.step, 0), **{name: planned[name] for name in later}}
    seconds = left[at.stage] * (step + fit)
    seconds += slower * sum(left[name] * (costs.stages[name].step + costs.stages[name].fit) for name in later)
    factor = max(0.0, budget - at.seconds - once) / seconds if seconds > 0 else 0.0

    steps = dict(planned)
    max_steps = {name: round(MAX_SHARE * cost.steps) for name, cost in costs.stages.items()}
    steps[at.stage] = min(at.step + round(factor * left[at.stage]), max(max_steps[at.stage], at.step))
    for name in later:
        steps[name] = min(max(1, round(factor * left[name])), max_steps[name])
    return steps
