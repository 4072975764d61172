"""Compare the decisions on effects of some runs with the truth.

    python -m benchmarks.effect_scenes build/effect-scenes
    neilfpp train --data build/effect-scenes/bowl --host mesh --out runs/bowl
    python -m benchmarks.effect_table runs/bowl

The output is a Markdown table with a row for each effect and a column for each run, whose capture is
identified by the name of its folder. "on" or "off" is the last decision; "wrong" marks a decision that
contradicts the truth. The reason of each wrong decision follows below the table.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import tyro
from rich.console import Console

from benchmarks.command import run_benchmark
from neilfpp_method.errors import UserError
from neilfpp_method.train.json_files import read_json

__all__ = ["TRUE_EFFECTS", "markdown"]

JUDGED = (
    "inter-reflection",
    "lamps",
    "environment-map",
    "coloured-light",
    "reflection",
    "long-tails",
    "rough-diffuse",
    "metals",
    "varying-roughness",
    "lobe-sampling",
)
GLOSSY = {"reflection", "varying-roughness", "lobe-sampling"}
SKY = {"environment-map", "coloured-light"}
TRUE_EFFECTS: Mapping[str, set[str]] = {
    "lambertian": SKY,
    "lamp": {"inter-reflection", "lamps", *GLOSSY},
    "bowl": {"inter-reflection", "environment-map", "reflection", "lobe-sampling"},
    "polished": {"inter-reflection", "metals", *SKY, *GLOSSY},
    "tabletop_env": {"inter-reflection", "metals", *SKY, *GLOSSY},
    "tabletop_mix": {"inter-reflection", "lamps", "metals", *SKY, *GLOSSY},
    "spot_city": {"inter-reflection", "long-tails", "rough-diffuse", "metals", *SKY, *GLOSSY},
    "spot_paint": {"inter-reflection", "long-tails", "rough-diffuse", *SKY, *GLOSSY},
}
"""The effects that each capture has, by the name of its folder: those of `effect_scenes`, and four others."""


@dataclass(frozen=True)
class Decided:
    """The effects of a run by name, from its `effects.json`, and the name of its capture."""

    capture: str
    effects: Mapping[str, Mapping[str, Any]]

    def is_wrong(self, name: str) -> bool:
        """Whether the last decision contradicts the truth."""
        return (self.effects[name]["decision"] == "on") != (name in TRUE_EFFECTS[self.capture])


def read_run(path: Path) -> Decided:
    """Read the decisions of a run.

    Raises:
        UserError: the run has no effects.json, or the effects of its capture are unknown.
    """
    if not (path / "effects.json").is_file():
        raise UserError(f"{path}: no effects.json", "give the folder of a run")
    capture = Path(read_json(path / "capture.json")["root"]).name
    if capture not in TRUE_EFFECTS:
        raise UserError(f"{path}: nothing is known of {capture}", f"choose among {', '.join(TRUE_EFFECTS)}")
    return Decided(capture, {row["effect"]: row for row in read_json(path / "effects.json")["effects"]})


def markdown(runs: Sequence[Decided]) -> list[str]:
    """The lines of the table, and one line for each wrong decision."""
    lines = ["| effect | " + " | ".join(run.capture for run in runs) + " |", "|---" * (len(runs) + 1) + "|"]
    for name in JUDGED:
        cells = [run.effects[name]["decision"] + (" (wrong)" if run.is_wrong(name) else "") for run in runs]
        lines.append(f"| {name} | " + " | ".join(cells) + " |")
    lines.append("")
    for run in runs:
        wrong = [name for name in JUDGED if run.is_wrong(name)]
        lines += [f"- {run.capture}, {name}: {run.effects[name]['reason']}" for name in wrong]
    return lines


@dataclass
class Options:
    """Tabulate the decisions of runs."""

    runs: tyro.conf.Positional[tuple[Path, ...]]
    """Folders of runs."""


def main(options: Options, console: Console) -> None:
    """Print the table."""
    for line in markdown([read_run(path) for path in options.runs]):
        console.print(line, markup=False, soft_wrap=True, highlight=False)


if __name__ == "__main__":
    run_benchmark(lambda: main(tyro.cli(Options), Console()))
