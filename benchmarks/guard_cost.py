"""Cost of the check for steps that are not finite, compared with that of the step.

    python -m benchmarks.guard_cost

It uses the preset `fast` with its own sizes and 512 rays, on the scene of the package. The check of `neilfpp
train` stores the state before a step (`train.skipped.Moment`), computes the norm of the gradient of each
field, and tests the values. The exit status is 1 if it takes more than a hundredth of a step in any stage.
"""

from __future__ import annotations

import math
import sys

import torch

from benchmarks.measure import hardware, median_seconds
from benchmarks.steps import model_of, pixels_of, step_of
from neilfpp_method.kernels.process import computing_fast
from neilfpp_method.schedule import Stage, StagePosition
from neilfpp_method.train.optimizer import gradient_norms
from neilfpp_method.train.skipped import Moment

RAYS = 512
LARGEST_SHARE = 0.01


def main() -> int:
    """Print the time of a step and of its check, by stage. Returns the exit status."""
    worst = 0.0
    print(hardware())
    for stage in Stage:
        model = model_of("fast").train()
        batch, position = pixels_of(RAYS), StagePosition(stage, 1, 2)
        step = step_of(model, stage, RAYS)

        def guard(model=model, batch=batch, position=position) -> bool:
            Moment.before_step(model, batch, position, step=0)
            norms = torch.stack(list(gradient_norms(model).values())).tolist()
            return all(map(math.isfinite, norms))

        with computing_fast():
            step()
            whole, guarding = median_seconds(step, guard)
        share = guarding / whole
        worst = max(worst, share)
        print(f"{stage.value}: a step {1e3 * whole:.1f} ms, its guard {1e3 * guarding:.2f} ms, {share:.2%}")
    return int(worst > LARGEST_SHARE)


if __name__ == "__main__":
    sys.exit(main())
