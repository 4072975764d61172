"""Make a run of a tradeoff, and tell how it ended."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

from rich.console import Console

from neilfpp_method.errors import EarlyEnd, Stopped
from neilfpp_method.tradeoff.planned_runs import PlannedRun, make_run
from neilfpp_method.train.budgeted import BudgetTooSmall

__all__ = ["Ending", "Report", "attempt"]

Report = Callable[[Path, str], None]
"""A function that writes the report of a run folder on a device. Other processes import it by its name."""


@dataclass(frozen=True)
class Ending:
    """How a run ended.

    Attributes:
        left_out: why the run has no result; empty if it has one.
        too_small: the largest budget that is known to be too small for this machine, in seconds; 0 if the
            budget of the run was large enough.
    """

    left_out: str = ""
    too_small: float = 0.0


def attempt(run: PlannedRun, device: str, console: Console, report: Report | None) -> Ending:
    """Make a run. It may be impossible: its budget may be too small, or it found no surface.

    Raises:
        Stopped: if the user stops it; it can be continued.
    """
    try:
        make_run(run, device, console, report)
    except Stopped:
        raise
    except BudgetTooSmall as error:
        return Ending(str(error), max(run.budget, error.needed))
    except EarlyEnd as error:
        return Ending(str(error))
    return Ending()
