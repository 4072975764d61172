"""The checks for steps that are not finite are cheap."""

from __future__ import annotations

import pytest

from benchmarks.guard_cost import LARGEST_SHARE, guard_costs

MEASUREMENTS = 3
"""The smallest of them counts, because other work on the machine only makes the checks slower."""


@pytest.mark.hard
@pytest.mark.timeout(900)
@pytest.mark.usefixtures("without_shape_checks")
def test_the_checks_take_less_than_a_hundredth_of_a_step():
    """Medians of processor time, of steps and checks that alternate in this process."""
    measured = [list(guard_costs()) for _ in range(MEASUREMENTS)]
    for costs in zip(*measured, strict=True):
        shares = [cost.share for cost in costs]
        print(costs[0].stage.value, shares)
        assert 0 < min(shares) < LARGEST_SHARE, (costs[0].stage, shares)
