"""The table of damaged files in docs/stability.md.

    python -m tests.hard_cases.hostile.campaign 10000                    print the table
    python -m tests.hard_cases.hostile.campaign 10000 --keep FOLDER      continue a campaign that was stopped
    python -m tests.hard_cases.hostile.campaign 0 --keep FOLDER --write  write the table into the document

The number is that of the inputs of a cheap reader; readers whose inputs cost milliseconds get a fifth of it.
All readers take turns, a chunk of inputs each, so a campaign that is stopped early has tried them evenly.
"""

from __future__ import annotations

import json
import re
import sys
import tempfile
import warnings
from dataclasses import asdict, dataclass, field
from pathlib import Path

import tyro

from tests.hard_cases.hostile.readers import READERS
from tests.hard_cases.hostile.worker import Outcome, attack

DOCUMENT = Path(__file__).parents[3] / "docs" / "stability.md"
MARKED = re.compile(r"(<!-- hostile -->\n).*?(<!-- end -->)", re.DOTALL)
CHUNK = 500
"""Inputs of a cheap reader between two saves."""


@dataclass
class Progress:
    """The outcomes of the inputs of each reader so far, and their number."""

    outcomes: dict[str, Outcome] = field(default_factory=dict)
    done: dict[str, int] = field(default_factory=dict)

    @staticmethod
    def read(path: Path) -> Progress:
        """The progress that `write` saved; an empty one if there is no such file."""
        if not path.exists():
            return Progress()
        saved = json.loads(path.read_text())
        return Progress({name: Outcome(**o) for name, o in saved["outcomes"].items()}, saved["done"])

    def write(self, path: Path) -> None:
        path.parent.mkdir(parents=True, exist_ok=True)
        temporary = path.with_suffix(".new")
        temporary.write_text(json.dumps(asdict(self), indent=1))
        temporary.replace(path)

    def add(self, name: str, count: int, outcome: Outcome) -> None:
        """Add the outcome of `count` more inputs of a reader."""
        total = self.outcomes.setdefault(name, Outcome())
        total.read += outcome.read
        total.refused += outcome.refused
        total.faults += outcome.faults
        total.grown = max(total.grown, outcome.grown)
        self.done[name] = self.done.get(name, 0) + count


def table(progress: Progress) -> str:
    """The outcomes of the inputs of each reader as a Markdown table."""
    rows = [
        "| reader | inputs | gave a value | refused in one line | faults | memory, MiB |",
        "|---|---|---|---|---|---|",
    ]
    for name in filter(progress.done.get, READERS):
        o = progress.outcomes[name]
        figures = (progress.done[name], o.read, o.refused, len(o.faults), o.grown >> 20)
        rows.append(f"| {name} | {' | '.join(f'{figure:,}' for figure in figures)} |")
    total = sum(progress.done.values())
    faults = sum(len(o.faults) for o in progress.outcomes.values())
    return "\n".join(rows) + f"\n\n{total:,} inputs, {faults} faults.\n"


def main(count: tyro.conf.Positional[int], keep: Path | None = None, write: bool = False) -> int:
    """Read damaged files with every reader; exit status 1 if there is a fault.

    Args:
        count: inputs of a cheap reader, numbered from 0; the same numbers are the same damage.
        keep: folder in which the progress is saved, and from which a stopped campaign continues.
        write: put the table into docs/stability.md.
    """
    warnings.simplefilter("ignore")
    record = keep / "progress.json" if keep else None
    progress = Progress.read(record) if record else Progress()
    for turn in range(CHUNK, count + CHUNK, CHUNK):
        for name, reader in READERS.items():
            begin, end = progress.done.get(name, 0), max(1, round(min(turn, count) * reader.share))
            if begin >= end:
                continue
            with tempfile.TemporaryDirectory() as folder:
                progress.add(name, end - begin, attack(reader, Path(folder) / "files", begin, end - begin))
            if record:
                progress.write(record)
    print(table(progress))
    for name, outcome in progress.outcomes.items():
        for number, file, what in outcome.faults:
            print(f"{name}, input {number}, {file}: {what}")
    if write:
        command = f"`python -m tests.hard_cases.hostile.campaign {max(progress.done.values())}`"
        section = f"{table(progress)}\n{command}\n"
        DOCUMENT.write_text(
            MARKED.sub(lambda m: f"{m[1]}\n{section}{m[2]}", DOCUMENT.read_text("utf-8")), "utf-8"
        )
    return int(any(outcome.faults for outcome in progress.outcomes.values()))


if __name__ == "__main__":
    sys.exit(tyro.cli(main))
