"""What the effects of a scene buy and cost: runs with `--effects auto`, `all` and `none` beside one another.

    python -m benchmarks.effect_scenes build/effect-scenes
    python -m benchmarks.effects_compared build/effect-scenes/* DATA/spot_paint --out runs/effects

Each capture is trained three times by the preset `fast` on its own mesh, so that the runs differ in light and
material alone. The output is a table of accuracy and training time, and below it the decisions of the `auto`
runs beside the truth (`effect_table`). Runs that exist are continued. `--save NAME` writes the figures for
docs/effects.md.
"""

from __future__ import annotations

import shlex
import sys
from dataclasses import dataclass
from pathlib import Path

import tyro
from rich.console import Console

from benchmarks.command import run_benchmark
from benchmarks.effect_table import TRUE_EFFECTS, read_run
from benchmarks.effect_table import markdown as decisions
from benchmarks.measure import hardware, revision
from benchmarks.results import measure, train
from benchmarks.tables import RESULTS, Result, Row, markdown, write_result
from neilfpp_method.effects.request import parse_effects
from neilfpp_method.settings.presets import fixed_geometry, preset
from neilfpp_method.train.json_files import read_json

__all__ = ["rows_of"]

REQUESTS = ("auto", "all", "none")
TABLE = "effects"


@dataclass
class Options:
    """Train captures with effects by evidence, with all effects, and with none."""

    captures: tyro.conf.Positional[tuple[Path, ...]]
    """Folders of captures with a mesh and known materials."""
    out: Path = Path("runs/effects")
    """Folder for the runs."""
    save: str | None = None
    """Name of the result file in benchmarks/results; default: the figures are only printed."""
    device: str = "auto"
    """Device to train on."""


def rows_of(capture: Path, out: Path, device: str) -> list[Row]:
    """Train and measure one capture with each of `REQUESTS`; one row for each."""
    config = fixed_geometry(preset("fast"))
    rows = []
    for request in REQUESTS:
        run = out / f"{capture.name}-{request}"
        train(capture, run, config, device, parse_effects(request))
        (figures,) = measure(run, config).values()
        seconds = sum(read_json(run / "timing.json").values())
        rows.append(Row(f"`{request}`", {**figures, "seconds": seconds}, capture.name))
    return rows


def main(options: Options, console: Console) -> None:
    """Train and measure all captures, and print both tables."""
    rows: list[Row] = []
    for capture in options.captures:
        rows += rows_of(capture, options.out, options.device)
        command = f"python -m benchmarks.effects_compared {shlex.join(sys.argv[1:])}"
        result = Result(TABLE, revision(), command, hardware(), tuple(rows))
        # Written after every capture, so that figures are kept if a later capture fails.
        if options.save is not None:
            write_result(RESULTS / f"{options.save}.json", result)
    judged = [
        read_run(options.out / f"{capture.name}-auto")
        for capture in options.captures
        if capture.name in TRUE_EFFECTS
    ]
    for line in (*markdown([result]).splitlines(), "", *decisions(judged)):
        console.print(line, markup=False, soft_wrap=True, highlight=False)


if __name__ == "__main__":
    run_benchmark(lambda: main(tyro.cli(Options), Console()))
