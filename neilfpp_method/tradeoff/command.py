"""`neilfpp tradeoff`: train with each time budget, evaluate, and write the frontier."""

from __future__ import annotations

from collections.abc import Callable, Collection, Sequence
from pathlib import Path

from rich.console import Console

from neilfpp_method.budget.durations import format_duration
from neilfpp_method.data.capture import load_capture
from neilfpp_method.errors import UserError
from neilfpp_method.tradeoff.files import write_tradeoff
from neilfpp_method.tradeoff.frontier import FIGURES, BudgetResult, RunResult, frontier
from neilfpp_method.tradeoff.planned_runs import (
    PlannedRun,
    TradeoffRequest,
    check_same,
    make_run,
    measured,
    plan_runs,
)
from neilfpp_method.train.output import check_folder

__all__ = ["run_tradeoff"]


def run_tradeoff(
    request: TradeoffRequest, console: Console, at_end: Callable[[Path], None] | None = None
) -> list[BudgetResult]:
    """Train and evaluate all runs that are not finished, one after the other, and write the frontier.

    The files are written again after each run. A run that cannot be made or measured is reported, left out,
    and tried again by the next call: its budget may be too small for this machine, or it found no surface.

    Args:
        request: the runs.
        console: where progress is printed.
        at_end: called with the folder of each run that has been trained.

    Returns:
        The points of the frontier.

    Raises:
        UserError: if the input is unusable, if the folder contains runs of another capture or with other
            settings, or if no run could be finished.
        Stopped: if the user stops the command; the next call continues it.
    """
    out, runs = request.out, plan_runs(request)
    # Errors in the capture are raised before anything is written.
    load_capture(request.data)
    check_folder(out)
    for run in runs:
        check_same(run)
    left_out: dict[str, str] = {}
    for number, run in enumerate(runs, start=1):
        console.print(f"run {number} of {len(runs)}: {run.name}", soft_wrap=True)
        try:
            make_run(run, console, at_end)
        except UserError as error:
            left_out[run.name] = str(error)
            console.print(f"left out: {error}", style="yellow", soft_wrap=True)
            continue
        title = f"{request.data.resolve().name}, {request.config.preset}"
        write_tradeoff(out, title, finished_runs(runs, left_out))
    finished = finished_runs(runs, left_out)
    if not finished:
        raise UserError(f"{out}: no run could be made", list(left_out.values())[-1])
    points = frontier(finished)
    for line in frontier_table(points):
        console.print(line, soft_wrap=True)
    console.print(f"written to {out / 'tradeoff.csv'}, tradeoff.json and tradeoff.svg", soft_wrap=True)
    return points


def finished_runs(runs: Sequence[PlannedRun], left_out: Collection[str]) -> list[RunResult]:
    """The results of the finished runs, without those of the given names."""
    results = (measured(run) for run in runs if run.name not in left_out)
    return [result for result in results if result is not None]


def frontier_table(points: Sequence[BudgetResult]) -> list[str]:
    """The frontier for the terminal: a line per budget, followed by the change of each metric per minute."""
    names = [name for name in FIGURES if points and name in points[0].figures]
    lines = ["budget      took   " + "  ".join(f"{FIGURES[name].title:>20}" for name in names)]
    for point in points:
        values = "  ".join(f"{_with_deviation(point, name):>20}" for name in names)
        mark = "  dominated" if point.dominated else ""
        lines.append(f"{format_duration(point.budget):8} {point.seconds:6.1f} s  {values}{mark}")
        if point.per_minute:
            gained = "  ".join(f"{point.per_minute[name]:+18.2f}/m" for name in names)
            lines.append(f"{'':19}{gained}")
    return lines


def _with_deviation(point: BudgetResult, name: str) -> str:
    value = f"{point.figures[name]:.2f}"
    return value + (f" ± {point.deviations[name]:.2f}" if name in point.deviations else "")
