"""`neilfpp tradeoff`: train with each time budget, evaluate, and write the frontier."""

from __future__ import annotations

from collections.abc import Collection, Sequence
from dataclasses import replace

from rich.console import Console

from neilfpp_method.budget.durations import format_duration
from neilfpp_method.data.capture import load_capture
from neilfpp_method.errors import UserError
from neilfpp_method.tradeoff.ending import Ending, Report
from neilfpp_method.tradeoff.files import write_tradeoff
from neilfpp_method.tradeoff.frontier import FIGURES, BudgetResult, RunResult, frontier
from neilfpp_method.tradeoff.machines import parse_devices, parse_slurm
from neilfpp_method.tradeoff.planned_runs import (
    PlannedRun,
    TradeoffRequest,
    check_same,
    is_complete,
    measured,
    plan_runs,
)
from neilfpp_method.tradeoff.queue import Engine, ThisProcess, work_through
from neilfpp_method.tradeoff.relighting import plan_relighting
from neilfpp_method.tradeoff.submitted import LocalProcesses, SlurmCluster
from neilfpp_method.train.device import pick_device
from neilfpp_method.train.output import check_folder

__all__ = ["run_tradeoff"]


def run_tradeoff(
    request: TradeoffRequest, console: Console, report: Report | None = None
) -> list[BudgetResult]:
    """Train and evaluate all runs that are not finished, and write the frontier.

    The files are written again after each run. A run that cannot be made or measured is reported, left out,
    and tried again by the next call: its budget may be too small for this machine, or it found no surface.

    Args:
        request: the runs.
        console: where progress is printed.
        report: writes the report of a run within its budget.

    Returns:
        The points of the frontier.

    Raises:
        UserError: if the input is unusable, if the folder contains runs of another capture or with other
            settings, or if no run could be finished.
        Stopped, KeyboardInterrupt: if the user stops the command; the next call continues it.
    """
    out = request.out
    runs = plan_runs(request)
    # Errors in the capture are raised before anything is written.
    capture = load_capture(request.data)
    light = plan_relighting(request.relight, request.truth, request.env_layout, capture)
    runs = [replace(run, light=light) for run in runs]
    check_folder(out)
    for run in runs:
        check_same(run)
    left_out: dict[str, str] = {}
    title = f"{request.data.resolve().name}, {request.config.preset}"

    def say(text: str, style: str | None = None) -> None:
        console.print(text, style=style, soft_wrap=True)

    def on_end(run: PlannedRun, ending: Ending) -> None:
        if ending.left_out:
            left_out[run.name] = ending.left_out
            say(f"{run.name} left out: {ending.left_out}", "yellow")
            return
        say(f"{run.name} finished")
        write_tradeoff(out, title, finished_runs(runs, left_out))

    missing = [run for run in runs if not is_complete(run, bool(capture.test_views))]
    engine = _engine(request, len(missing), console, report)
    if len(missing) < len(runs):
        say(f"{len(runs) - len(missing)} of {len(runs)} runs are finished already")
        write_tradeoff(out, title, finished_runs(runs, left_out))
    work_through(missing, engine, say, on_end)
    finished = finished_runs(runs, left_out)
    if not finished:
        raise UserError(f"{out}: no run could be made", list(left_out.values())[-1])
    points = frontier(finished)
    for line in frontier_table(points):
        say(line)
    say(f"written to {out / 'tradeoff.csv'}, tradeoff.json and tradeoff.svg")
    return points


def _engine(request: TradeoffRequest, runs: int, console: Console, report: Report | None) -> Engine:
    """What starts the runs, as the options `--device` and `--slurm` say.

    Raises:
        UserError: if an option is invalid, a device is missing, or submitit is needed and missing.
    """
    devices = parse_devices(request.device)
    if request.slurm is not None:
        if len(devices) > 1:
            raise UserError("--slurm starts each run on one device", "leave --device out")
        return SlurmCluster(parse_slurm(request.slurm), request.device, runs, request.out, report)
    if len(devices) > 1:
        return LocalProcesses(devices, request.out, report)
    pick_device(request.device)
    return ThisProcess(request.device, console, report)


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
