"""Write a frontier as `tradeoff.csv` (a line per run), `tradeoff.json` (runs and points), `tradeoff.svg`."""

from __future__ import annotations

import csv
import dataclasses
import io
from collections.abc import Sequence
from pathlib import Path

from neilfpp_method.budget.durations import format_duration
from neilfpp_method.data.files.atomic_file import replacing
from neilfpp_method.data.files.json_entry import write_json
from neilfpp_method.tradeoff.figure import draw_frontier
from neilfpp_method.tradeoff.frontier import FIGURES, RunResult, frontier
from neilfpp_method.train.provenance import provenance

__all__ = ["write_tradeoff"]

FORMAT = 1
"""Version of the layout of `tradeoff.json`."""


def write_tradeoff(out: Path, title: str, runs: Sequence[RunResult]) -> None:
    """Write the three files, each atomically."""
    points = frontier(runs)
    names = [name for name in FIGURES if any(name in run.figures for run in runs)]
    dominated = {point.budget: point.dominated for point in points}
    text = io.StringIO()
    lines = csv.writer(text, lineterminator="\n")
    lines.writerow(["budget", "seed", "budget_seconds", "seconds", *names, "dominated"])
    for run in runs:
        figures = [f"{run.figures[name]:.4f}" if name in run.figures else "" for name in names]
        values = [format_duration(run.budget), run.seed, f"{run.budget:.0f}", f"{run.seconds:.2f}"]
        lines.writerow([*values, *figures, "yes" if dominated[run.budget] else "no"])
    stored = {
        "format": FORMAT,
        "title": title,
        "machine": {name: value for name, value in provenance().items() if name != "command"},
        "runs": [dataclasses.asdict(run) for run in runs],
        "points": [dataclasses.asdict(point) for point in points],
    }
    for name, content in (("tradeoff.csv", text.getvalue()), ("tradeoff.svg", draw_frontier(title, points))):
        with replacing(out / name) as temporary:
            temporary.write_text(content, encoding="utf-8")
    write_json(out / "tradeoff.json", stored)
