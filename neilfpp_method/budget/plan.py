"""How many steps of each stage fit into a time: from what a trial measured, and again by the clock of the
run.

A stage costs its steps, each with its share of the fits of the light, and what happens once at its start and
at its end. The stages keep the proportions that the settings have; one factor, the `share`, makes them fit:

    share · Σ steps · (step + fit) = budget − spent − Σ once − reserve

While the run goes on the same sum is solved for what is left, with the rates that the clock has shown.
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
"""Of the steps of the settings; with fewer there is nothing to look at: in `fast` the distance field has then
had 200 steps, and the light a single fit.
"""
MAX_SHARE = 8.0
"""Of the steps of the settings; whether more bring anything was never tried."""
TRUSTED_STEPS = 40
"""So many steps of a stage the measurement of the trial counts for, beside those that the run has taken."""
SPARE = 1.15
"""Factor from the time that is needed to the smallest budget that is named: a trial errs."""


@dataclass(frozen=True)
class StageCost:
    """What a stage costs, seconds.

    Attributes:
        steps: of the settings; the proportion of the stages.
        step: of one step.
        fit: of the fits of the light, to a step, without the first fit of the run.
        start: once, before its first step: evidence for effects.
        first_fit: once, in its first steps: the first fit of the light takes longer than those after it.
        end: once, at its end: pictures, looks, a checkpoint.
    """

    steps: int
    step: float
    fit: float = 0.0
    start: float = 0.0
    end: float = 0.0
    first_fit: float = 0.0

    @property
    def once(self) -> float:
        """What does not depend on the number of steps."""
        return self.start + self.first_fit + self.end


@dataclass(frozen=True)
class Costs:
    """What a training costs: its stages in order, those without steps left out, and what comes after them
    (the report), seconds.
    """

    stages: Mapping[str, StageCost]
    reserve: float = 0.0

    @property
    def once(self) -> float:
        """All that does not depend on the number of steps."""
        return self.reserve + sum(cost.once for cost in self.stages.values())

    @property
    def all_steps(self) -> float:
        """All steps of the settings."""
        return sum(cost.steps * (cost.step + cost.fit) for cost in self.stages.values())


@dataclass(frozen=True)
class Progress:
    """Where a run stands.

    Attributes:
        stage: the one that it is in.
        step: how many steps of that are over.
        seconds: of the run so far.
        stepping: of them, those of the steps of this stage, without fits of the light.
        fitting: of them, those of fits of the light in this stage.
    """

    stage: str
    step: int
    seconds: float
    stepping: float
    fitting: float


def share_for(costs: Costs, budget: float, spent: float) -> float:
    """The factor on the steps of the settings that fills the budget, at most `MAX_SHARE`; below `MIN_SHARE`
    the budget is too small.

    Args:
        costs: of the training.
        budget: seconds of all.
        spent: seconds that are gone.

    >>> share_for(Costs({"joint": StageCost(steps=100, step=0.5, end=10.0)}, reserve=5.0), 50.0, 10.0)
    0.5
    """
    return min((budget - spent - costs.once) / max(costs.all_steps, 1e-9), MAX_SHARE)


def steps_for(costs: Costs, share: float) -> dict[str, int]:
    """Steps of each stage, one at least."""
    return {stage: max(1, round(share * cost.steps)) for stage, cost in costs.stages.items()}


def smallest_budget(costs: Costs, spent: float) -> float:
    """The smallest budget that makes sense, seconds: rounded up to 5 s, from 3 minutes on to half a
    minute.
    """
    needed = SPARE * (spent + costs.once + MIN_SHARE * costs.all_steps)
    unit = 5.0 if needed <= 180.0 else 30.0
    return unit * math.ceil(needed / unit)


def revised_steps(costs: Costs, planned: Mapping[str, int], at: Progress, budget: float) -> dict[str, int]:
    """The steps of each stage that keep a run to its budget, by what the clock has shown.

    Stages that are over stay as they were. In the current stage the rate is the mean over its steps so far
    and `TRUSTED_STEPS` of the trial's. Later stages are taken to be slower or faster than the trial by the
    same factor. Where no time is left, the current stage ends now, and later ones have a step each.

    Args:
        costs: as the trial measured them.
        planned: steps of each stage so far.
        at: where the run stands.
        budget: seconds of all.
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
    most = {name: round(MAX_SHARE * cost.steps) for name, cost in costs.stages.items()}
    steps[at.stage] = min(at.step + round(factor * left[at.stage]), max(most[at.stage], at.step))
    for name in later:
        steps[name] = min(max(1, round(factor * left[name])), most[name])
    return steps
