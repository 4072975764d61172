"""Cost of the check for steps that are not finite, compared with that of the step.

    python -m benchmarks.guard_cost

It uses the preset `fast` with its own sizes and 512 rays, on the scene of the package. The check of `neilfpp
train` stores the state before a step (`train.skipped.Moment`), computes the norm of the gradient of each
field, and tests the values. The check of an attached host and of the nerfstudio plugin is
`health.guard.StepGuard`. The exit status is 1 if one of them takes more than a hundredth of a step in any
stage.
"""

from __future__ import annotations

import math
import sys
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from functools import partial

import torch

from benchmarks.measure import hardware, median_seconds
from benchmarks.steps import model_of, pixels_of, step_of
from neilfpp_method.health.guard import StepGuard
from neilfpp_method.kernels.process import computing_fast
from neilfpp_method.model import NeilfModel
from neilfpp_method.schedule import Stage, StagePosition, active_losses, weigh
from neilfpp_method.train.optimizer import gradient_norms
from neilfpp_method.train.skipped import Moment

__all__ = ["LARGEST_SHARE", "GuardCost", "guard_costs"]

RAYS = 512
LARGEST_SHARE = 0.01


@dataclass(frozen=True)
class GuardCost:
    """Medians of the durations of a step of a stage, and of its check in each training loop, seconds."""

    stage: Stage
    step: float
    standalone: float
    attached: float

    @property
    def share(self) -> float:
        """The larger of the two checks as a share of the step."""
        return max(self.standalone, self.attached) / self.step


def guard_costs() -> Iterator[GuardCost]:
    """Measure the cost for each stage. Steps and checks alternate.

    The gradients are read once before the checks. In a loop the optimizer reads them right after the check,
    so only one of the two waits for memory.
    """
    for stage in Stage:
        model = model_of("fast").train()
        step = step_of(model, stage, RAYS)
        with computing_fast():
            step()
            checks = standalone_check(model, stage), attached_check(model, stage)
            seconds, _, *taken = median_seconds(step, partial(gradient_norms, model), *checks)
            yield GuardCost(stage, seconds, *taken)


def standalone_check(model: NeilfModel, stage: Stage) -> Callable[[], object]:
    """The check of the loop of `neilfpp train`."""
    batch, position = pixels_of(RAYS), StagePosition(stage, 1, 2)

    def check() -> bool:
        Moment.before_step(batch, position, step=0)
        norms = torch.stack(list(gradient_norms(model).values())).tolist()
        return all(map(math.isfinite, norms))

    return check


class Still(torch.optim.Optimizer):
    """An optimizer that changes nothing, so that only the check before its step takes time."""

    def step(self, closure: None = None) -> None:
        pass


def attached_check(model: NeilfModel, stage: Stage) -> Callable[[], object]:
    """The check of a training loop outside of the package, with one optimizer for each field."""
    guard, losses = StepGuard(print), model.losses(pixels_of(RAYS), stage)
    terms = weigh(losses, active_losses(stage, model.config, model.stages)).terms
    groups = {name: p for name, p in model.parameter_groups().items() if p}
    optimizers = [Still([{"params": p, "name": name}], {}) for name, p in groups.items()]
    for optimizer in optimizers:
        guard.watch(optimizer)

    def check() -> None:
        guard.begin_step(terms, 0)
        for optimizer in optimizers:
            optimizer.step()

    return check


def main() -> int:
    """Print the time of a step and of its checks, by stage. Returns the exit status."""
    worst = 0.0
    print(hardware())
    for cost in guard_costs():
        worst = max(worst, cost.share)
        checks = ", ".join(
            f"{name} {1e3 * seconds:.2f} ms, {seconds / cost.step:.2%}"
            for name, seconds in (("its guard", cost.standalone), ("of an attached host", cost.attached))
        )
        print(f"{cost.stage.value}: a step {1e3 * cost.step:.1f} ms, {checks}")
    return int(worst > LARGEST_SHARE)


if __name__ == "__main__":
    sys.exit(main())
