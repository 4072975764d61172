"""The plan of a run with a budget, in `RUN/plan.json`: what the trial measured, what was planned, and every
time that the clock changed it.

format; budget, seconds; size; costs; places_looked_at; light_pixels; took, seconds, at the end
revisions, in order, of which the first is the plan that the training began with: seconds of the run, step,
and steps of each stage
"""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Literal

from neilfpp_method.budget.plan import Costs, StageCost
from neilfpp_method.errors import UserError
from neilfpp_method.schedule import Stage
from neilfpp_method.settings.plain import from_dict
from neilfpp_method.train.json_files import is_finite_number, read_json, write_json

__all__ = ["FILE", "BudgetPlan", "Revision", "read_budget", "write_budget"]

FILE = "plan.json"
FORMAT = 1
STAGES = tuple(stage.value for stage in Stage)


@dataclass(frozen=True)
class Revision:
    """Steps of each stage, as planned after `step` steps and `seconds` of the run."""

    seconds: float
    step: int
    steps: Mapping[str, int]


@dataclass
class BudgetPlan:
    """The plan of a run.

    Attributes:
        budget: seconds of all.
        size: of a step (`budget.sizes`).
        costs: as the trial measured them.
        places_looked_at: whether evidence of places decides about materials and light, where that is open.
        light_pixels: pixels from which the first light is found at most; 0: it is not looked for; None: as
            without a budget.
        revisions: in order; the last one counts.
        took: seconds of the whole command, report included; none: it has not come to its end.
    """

    budget: float
    size: Literal["small", "usual", "large"]
    costs: Costs
    places_looked_at: bool
    light_pixels: int | None = None
    revisions: list[Revision] = field(default_factory=list)
    took: float | None = None

    @property
    def steps(self) -> Mapping[str, int]:
        """Of each stage, as planned last."""
        return self.revisions[-1].steps


def write_budget(run: Path, plan: BudgetPlan) -> None:
    """The plan so far."""
    write_json(run / FILE, {"format": FORMAT, **dataclasses.asdict(plan)})


def read_budget(run: Path) -> BudgetPlan | None:
    """The plan of a run; none: it has no budget.

    Raises:
        UserError: the file is damaged or of another version.
    """
    path = run / FILE
    if not path.is_file():
        return None
    stored = read_json(path)
    if stored.get("format") != FORMAT:
        raise UserError(f"{path}: a plan of another version", "use the version of neilfpp that wrote the run")
    try:
        plan = _plan(stored, str(path))
    except (TypeError, AttributeError, KeyError) as error:
        raise UserError(
            f"{path}: not a complete plan ({error})", "restore the file or train again"
        ) from error
    if not plan.revisions or not _sensible(plan):
        raise UserError(f"{path}: a plan with impossible numbers", "restore the file or train again")
    return plan


def _plan(stored: Mapping[str, Any], where: str) -> BudgetPlan:
    stages = {name: from_dict(StageCost, cost, where) for name, cost in stored["costs"]["stages"].items()}
    plain = {name: stored[name] for name in ("budget", "size", "places_looked_at", "took")}
    plain["light_pixels"] = stored.get("light_pixels")
    revisions = [
        Revision(float(entry["seconds"]), entry["step"], dict(entry["steps"]))
        for entry in stored["revisions"]
    ]
    return BudgetPlan(**plain, costs=Costs(stages, stored["costs"]["reserve"]), revisions=revisions)


def _sensible(plan: BudgetPlan) -> bool:
    costs = plan.costs.stages.values()
    seconds = [plan.budget, plan.costs.reserve, *(n for c in costs for n in (c.step, c.fit, c.once))]
    seconds += [revision.seconds for revision in plan.revisions] + [plan.took or 0.0]
    counts = [
        *(cost.steps for cost in costs),
        plan.light_pixels or 0,
        *(n for r in plan.revisions for n in (r.step, *r.steps.values())),
    ]
    same = all(list(revision.steps) == list(plan.costs.stages) for revision in plan.revisions)
    return (
        same
        and set(plan.costs.stages) <= set(STAGES)
        and all(is_finite_number(n) and n >= 0 for n in seconds)
        and all(isinstance(n, int) and n >= 0 for n in counts)
        and plan.size in ("small", "usual", "large")
    )
