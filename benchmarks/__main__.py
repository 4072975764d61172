"""The benchmarks with a committed baseline.

    python -m benchmarks                    every suite
    python -m benchmarks kernels shading    some of them
    python -m benchmarks --compare          exit status 1 where a figure is worse than its tolerance allows
    python -m benchmarks --save             these figures become the baseline

A suite is a module with `measurements()`. docs/performance.md has curves and tables with other commands.
"""

from __future__ import annotations

import importlib
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path

import tyro
from rich.console import Console
from rich.table import Table

from benchmarks.command import run_benchmark
from benchmarks.measure import Measurement, hardware
from neilfpp_method.data.files.json_entry import write_json
from neilfpp_method.errors import UserError
from neilfpp_method.train.json_files import read_json

__all__ = ["SUITES", "compare", "merged"]

BASELINE = Path(__file__).parent / "baseline.json"
SUITES: Mapping[str, str] = {
    "kernels": "benchmarks.sdf_normals",
    "shading": "benchmarks.shading_samples",
    "steps": "benchmarks.steps",
    "sampler": "benchmarks.sampler",
    "trace": "benchmarks.trace",
    "joint": "benchmarks.joint",
}


@dataclass
class Options:
    """Measure, and compare with the committed figures."""

    names: tyro.conf.Positional[tuple[str, ...]] = ()
    """Names of suites; default: all."""
    compare: bool = False
    """Exit with status 1 if a figure is worse than the baseline by more than its tolerance."""
    save: bool = False
    """Write the figures into the baseline."""


def compare(measured: Sequence[Measurement], baseline: Mapping[str, float]) -> list[str]:
    """The names of the figures that are worse than the baseline permits. A figure without a baseline is never
    worse.
    """
    return [m.name for m in measured if m.name in baseline and m.worse_than(baseline[m.name])]


def merged(measured: Sequence[Measurement], old: Mapping[str, object], machine: str) -> dict[str, object]:
    """The contents of the baseline file after the new figures have replaced those of the same name."""
    figures = {
        **old.get("figures", {}),
        **{m.name: {k: v for k, v in asdict(m).items() if k != "name"} for m in measured},
    }
    return {"hardware": machine, "figures": dict(sorted(figures.items()))}


def main(options: Options, console: Console) -> int:
    """Run the suites. Returns the exit status."""
    unknown = set(options.names) - set(SUITES)
    if unknown:
        raise UserError(f"unknown benchmark '{min(unknown)}'", f"choose among {', '.join(SUITES)}")
    old = read_json(BASELINE) if BASELINE.exists() else {}
    known = {name: figure["value"] for name, figure in old.get("figures", {}).items()}
    console.print(hardware(), markup=False)
    measured: list[Measurement] = []
    for name in options.names or SUITES:
        for measurement in importlib.import_module(SUITES[name]).measurements():
            console.print(
                f"{measurement.name}: {measurement.value:.3g} {measurement.unit}",
                markup=False,
                highlight=False,
            )
            measured.append(measurement)
    if options.save:
        now = read_json(BASELINE) if BASELINE.exists() else {}  # others may have saved meanwhile
        write_json(BASELINE, merged(measured, now, hardware()))
    worse = compare(measured, known) if options.compare else []
    if options.compare:
        console.print(_table(measured, known, worse))
    return 1 if worse else 0


def _table(measured: Sequence[Measurement], known: Mapping[str, float], worse: Sequence[str]) -> Table:
    table = Table("", "now", "baseline", "better", "tolerance", "")
    for m in measured:
        before = f"{known[m.name]:.3g}" if m.name in known else "–"
        allowed = "–" if m.tolerance is None else f"{100 * m.tolerance:.0f} %"
        table.add_row(
            m.name, f"{m.value:.3g} {m.unit}", before, m.better, allowed, "WORSE" if m.name in worse else ""
        )
    return table


if __name__ == "__main__":
    run_benchmark(lambda: main(tyro.cli(Options), Console()))
