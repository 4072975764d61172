"""`neilfpp tradeoff`: train for each budget, measure, and write the frontier."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from pathlib import Path

from rich.console import Console

from neilfpp_method.budget.durations import in_words
from neilfpp_method.data.capture import load_capture
from neilfpp_method.errors import UserError
from neilfpp_method.settings.types import NeilfConfig
from neilfpp_method.tradeoff.files import write_tradeoff
from neilfpp_method.tradeoff.frontier import FIGURES, Point, frontier
from neilfpp_method.tradeoff.rows import Row, measured, rows_of, run_row
from neilfpp_method.train.run import check_folder, read_description

__all__ = ["run_tradeoff"]


def run_tradeoff(
    data: Path,
    out: Path,
    config: NeilfConfig,
    budgets: Sequence[float],
    seeds: int,
    device: str,
    console: Console,
    at_end: Callable[[Path], None] | None = None,
) -> list[Point]:
    """Run every row that has not come to its end, one after the other, and write the frontier into `out`.

    The files are written anew after each row. A budget that is too small for this machine is said, left out,
    and tried again by the next call.

    Args:
        data: the capture.
        out: the folder of the runs and of the frontier.
        config: the settings of all rows; seeds count on from theirs.
        budgets: seconds.
        seeds: runs of each budget.
        device: where to compute.
        console: where to speak.
        at_end: called with the folder of a run that has been trained.

    Raises:
        UserError: bad input, rows of another capture or other settings in `out`, or no row came to its end.
        Stopped: a person asked for it; the next call goes on.
    """
    rows = rows_of(data, out, config, budgets, seeds, device)
    load_capture(data)  # what is wrong with it is told before anything is written
    check_folder(out)
    for row in rows:
        _check_same(row)
    refused = ""
    for number, row in enumerate(rows, start=1):
        console.print(f"row {number} of {len(rows)}: {row.name}", soft_wrap=True)
        try:
            run_row(row, console, at_end)
        except UserError as error:
            if (row.out / "config.json").is_file():
                raise
            refused = str(error)
            console.print(f"left out: {refused}", style="yellow", soft_wrap=True)
            continue
        runs = [found for found in map(measured, rows) if found is not None]
        write_tradeoff(out, f"{data.resolve().name}, {config.preset}", runs)
    runs = [found for found in map(measured, rows) if found is not None]
    if not runs:
        raise UserError(f"{out}: no row could be run", refused)
    points = frontier(runs)
    for line in table(points):
        console.print(line, soft_wrap=True)
    console.print(f"written to {out / 'tradeoff.csv'}, tradeoff.json and tradeoff.svg", soft_wrap=True)
    return points


def _check_same(row: Row) -> None:
    """That a run which is there already is the one that this row would make."""
    if not (row.out / "config.json").is_file():
        return
    described = read_description(row.out)
    same = described.source.root == str(row.data.resolve()) and described.config.preset == row.config.preset
    if not same or described.config.train.seed != row.config.train.seed:
        raise UserError(f"{row.out}: a run of another capture or with other settings", "choose another --out")


def table(points: Sequence[Point]) -> list[str]:
    """The frontier for a terminal: a line for each budget, and below it what each minute brought."""
    names = [name for name in FIGURES if points and name in points[0].figures]
    lines = ["budget      took   " + "  ".join(f"{FIGURES[name].title:>20}" for name in names)]
    for point in points:
        told = "  ".join(f"{_with_deviation(point, name):>20}" for name in names)
        mark = "  dominated" if point.dominated else ""
        lines.append(f"{in_words(point.budget):8} {point.seconds:6.1f} s  {told}{mark}")
        if point.per_minute:
            gained = "  ".join(f"{point.per_minute[name]:+18.2f}/m" for name in names)
            lines.append(f"{'':19}{gained}")
    return lines


def _with_deviation(point: Point, name: str) -> str:
    value = f"{point.figures[name]:.2f}"
    return value + (f" ± {point.deviations[name]:.2f}" if name in point.deviations else "")
