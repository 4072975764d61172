"""Accuracy over training time on several captures, for docs/budget.md.

    neilfpp tradeoff --data DATA/tabletop_mix --budgets 3m,10m --seeds 3 --out runs/frontier-tabletop_mix
    python -m benchmarks.frontier runs/frontier-tabletop_mix --commit d58f1d1 --machine "Xeon, one thread"

The frontiers of `neilfpp tradeoff` become the result file `benchmarks/results/frontier.json`, with a row for
the mean and one for the standard deviation of each budget, and a figure `docs/frontier_CAPTURE.svg` each.
Held-back pixels are left out: the captures have test views, which are many more pixels.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import tyro
from rich.console import Console

from benchmarks.command import run_benchmark
from benchmarks.tables import RESULTS, ROOT, Result, Row, markdown, write_result
from neilfpp_method.budget.durations import format_duration
from neilfpp_method.errors import UserError
from neilfpp_method.tradeoff.figure import draw_frontier
from neilfpp_method.tradeoff.frontier import RunResult, frontier
from neilfpp_method.train.json_files import read_json

__all__ = ["frontier_rows", "read_runs"]

HELD_BACK = "held_back_psnr"


def read_runs(folder: Path) -> list[RunResult]:
    """The runs of a frontier.

    Raises:
        UserError: the folder has no tradeoff.json.
    """
    if not (folder / "tradeoff.json").is_file():
        raise UserError(f"{folder}: no tradeoff.json", "give the folder that neilfpp tradeoff wrote")
    runs = [RunResult(**run) for run in read_json(folder / "tradeoff.json")["runs"]]
    return [
        replace(run, figures={name: run.figures[name] for name in run.figures if name != HELD_BACK})
        for run in runs
    ]


def frontier_rows(capture: str, runs: Sequence[RunResult]) -> list[Row]:
    """A row for the mean of each budget and, with several seeds, one for the standard deviation."""
    rows = []
    for point in frontier(runs):
        label = format_duration(point.budget)
        figures = {**point.figures, "seconds": point.seconds}
        rows.append(Row(f"{label}, mean of {point.runs}" if point.runs > 1 else label, figures, capture))
        if point.deviations:
            rows.append(Row(f"{label}, standard deviation", point.deviations, capture))
    return rows


@dataclass
class Options:
    """Write a table and figures of frontiers."""

    folders: tyro.conf.Positional[tuple[Path, ...]]
    """Folders that `neilfpp tradeoff` wrote, named frontier-CAPTURE."""
    commit: str
    """The version that was measured."""
    machine: str
    """The machine, its load, and the number of threads."""
    command: str = (
        "neilfpp tradeoff --data DATA/CAPTURE --budgets 3m,10m --seeds 3 --out runs/frontier-CAPTURE"
    )
    """The command that wrote the folders."""


def main(options: Options, console: Console) -> None:
    """Write the result file and the figures, and print the table."""
    rows = []
    for folder in options.folders:
        capture, runs = folder.name.removeprefix("frontier-"), read_runs(folder)
        rows += frontier_rows(capture, runs)
        title = read_json(folder / "tradeoff.json")["title"]
        figure = draw_frontier(title, frontier(runs))
        (ROOT / "docs" / f"frontier_{capture}.svg").write_text(figure, "utf-8")
    result = Result("frontier", options.commit, options.command, options.machine, tuple(rows))
    write_result(RESULTS / "frontier.json", result)
    console.print(markdown([result]), markup=False, highlight=False, soft_wrap=True)


if __name__ == "__main__":
    run_benchmark(lambda: main(tyro.cli(Options), Console()))
