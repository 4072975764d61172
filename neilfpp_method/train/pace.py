"""Keep a training within its time budget by planning its remaining steps again from measured times."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path

from neilfpp_method.budget.plan import Progress, revised_steps
from neilfpp_method.schedule import Stage, StagePosition
from neilfpp_method.settings.types import TrainConfig
from neilfpp_method.timing.ledger import Ledger
from neilfpp_method.train.budget_record import BudgetPlan, Revision, write_budget
from neilfpp_method.train.run import rewrite_training

__all__ = ["Pace", "with_steps"]

MIN_REVISION_SHARE = 0.02
"""Minimum time between two revisions of the plan, as a share of the budget."""
SETTINGS = {
    Stage.SDF_INIT: "sdf_steps",
    Stage.MATERIAL_INIT: "material_steps",
    Stage.JOINT: "joint_steps",
}
"""Name of the setting that holds the number of steps of each stage."""


def with_steps(config: TrainConfig, steps: Mapping[str, int]) -> TrainConfig:
    """The settings with other numbers of steps; a stage that is not in `steps` gets none."""
    return replace(config, **{setting: steps.get(stage.value, 0) for stage, setting in SETTINGS.items()})


@dataclass
class Pace:
    """Adapts the number of steps of a training to its time budget.

    Attributes:
        plan: the plan, to which revisions are added.
        ledger: the clock.
        revised_at: time of the last revision, in seconds.
    """

    plan: BudgetPlan
    ledger: Ledger
    revised_at: float = 0.0

    def revise(self, config: TrainConfig, position: StagePosition, step: int) -> TrainConfig:
        """Plan the remaining steps again if it is time to do so.

        Args:
            config: the settings with the steps planned so far.
            position: the stage, the number of its steps trained so far, and its length.
            step: number of steps trained so far in all stages.

        Returns:
            The settings with the new steps; `config` itself if nothing has changed.
        """
        now = self.ledger.total
        if now - self.revised_at < MIN_REVISION_SHARE * self.plan.budget or position.step >= position.length:
            return config
        self.revised_at = now
        stage = position.stage.value
        parts = self.ledger.seconds().get(stage, {})
        fitting = parts.get("light_fits", 0.0)
        at = Progress(stage, position.step, now, sum(parts.values()) - fitting, fitting)
        steps = revised_steps(self.plan.costs, self.plan.steps, at, self.plan.budget)
        if steps == self.plan.steps:
            return config
        self.plan.revisions.append(Revision(now, step, steps))
        return with_steps(config, steps)

    def save(self, run: Path, config: TrainConfig) -> None:
        """Write the plan into the run folder, and the planned steps into the settings stored there."""
        rewrite_training(run, config)
        write_budget(run, self.plan)
