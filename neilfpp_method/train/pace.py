"""Keeps a training to its budget: now and then its steps are planned again by its own clock."""

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

EVERY = 0.02
"""Of the budget between two looks at the clock."""
SETTINGS = {
    Stage.SDF_INIT: "sdf_steps",
    Stage.MATERIAL_INIT: "material_steps",
    Stage.JOINT: "joint_steps",
}
"""What the settings of the loop call the steps of a stage."""


def with_steps(config: TrainConfig, steps: Mapping[str, int]) -> TrainConfig:
    """The settings of the loop with other numbers of steps; stages that are not named have none."""
    return replace(config, **{setting: steps.get(stage.value, 0) for stage, setting in SETTINGS.items()})


@dataclass
class Pace:
    """Keeps a training to its plan, and the plan to the clock.

    Attributes:
        plan: takes the revisions.
        ledger: the clock.
        looked: seconds at the last look at it.
    """

    plan: BudgetPlan
    ledger: Ledger
    looked: float = 0.0

    def keep(self, config: TrainConfig, position: StagePosition, step: int) -> TrainConfig:
        """The settings to go on with.

        Args:
            config: what was planned so far.
            position: how many steps of the stage are over, and how many it has.
            step: how many steps have been trained.
        """
        now = self.ledger.total
        if now - self.looked < EVERY * self.plan.budget or position.step >= position.length:
            return config
        self.looked = now
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
        """The plan into the run's folder, and the steps of its stages into the settings there: all who load
        the run find them as they are.
        """
        rewrite_training(run, config)
        write_budget(run, self.plan)
