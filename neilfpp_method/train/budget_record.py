"""The plan of a run with a time budget, stored in `RUN/plan.json`.

It holds the costs that the trial measured, the planned steps, and every revision of them. The keys of the
file are `format` and the attributes of `BudgetPlan`.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Literal

from neilfpp_method.budget.plan import Costs, StageCost
from neilfpp_method.data.files.json_entry import write_json
from neilfpp_method.errors import UserError
from neilfpp_method.schedule import Stage
from neilfpp_method.settings.plain import from_dict
from neilfpp_method.train.json_files import is_finite_number, read_json

__all__ = ["FILE", "BudgetPlan", "Revision", "read_budget", "write_budget"]

FILE = "plan.json"
FORMAT = 1
"""Version of the file's layout."""
STAGES = tuple(stage.value for stage in Stage)


@dataclass(frozen=True)
class Revision:
    """Planned numbers of steps.

    Attributes:
        seconds: time of the run at which they were planned.
        step: number of steps trained by then.
        steps: planned steps of each stage.
    """

    seconds: float
    step: int
    steps: Mapping[str, int]


@dataclass
class BudgetPlan:
    """The plan of a run with a time budget.

    Attributes:
        budget: time of the whole command, in seconds.
        size: size of a step (`budget.sizes`).
        costs: costs that the trial measured.
        places_looked_at: whether there is time to measure evidence at places
            (`effects.evidence.material`), which decides open effects of material and light.
        light_pixels: maximum number of pixels for the search of the initial light; 0 for no search; None for
            the number without a budget.
        revisions: all plans in order, beginning with that before training; the last one applies.
        took: time of the whole command including the report, in seconds; None until it has ended.
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
        """Steps of each stage in the last plan."""
        return self.revisions[-1].steps


def write_budget(run: Path, plan: BudgetPlan) -> None:
    """Write the plan into the run folder."""
    write_json(run / FILE, {"format": FORMAT, **dataclasses.asdict(plan)})


def read_budget(run: Path) -> BudgetPlan | None:
    """Read the plan of a run.

    Returns:
        The plan; None if the run has no budget.

    Raises:
        UserError: if the file is damaged or of another version.
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
    """Whether all times and counts are finite and not negative, and all revisions have the same stages."""
    costs = plan.costs.stages.values()
    seconds = [plan.budget, plan.costs.reserve, *(n for c in costs for n in (c.step, c.fit, c.once))]
    seconds += [revision.seconds for revision in plan.revisions] + [plan.took or 0.0]
    counts = [
        *(cost.steps for cost in costs),
        plan.light_pixels or 0,
        *(n for r in plan.revisions for n in (r.step, *r.steps.values())),
    ]
    same_stages = all(list(revision.steps) == list(plan.costs.stages) for revision in plan.revisions)
    return (
        same_stages
        and set(plan.costs.stages) <= set(STAGES)
        and all(is_finite_number(n) and n >= 0 for n in seconds)
        and all(isinstance(n, int) and n >= 0 for n in counts)
        and plan.size in ("small", "usual", "large")
    )
