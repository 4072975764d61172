"""The table of damaged files in docs/stability.md.

    python -m tests.hard_cases.hostile.campaign 10000                    print the table
    python -m tests.hard_cases.hostile.campaign 10000 --keep FOLDER      continue a campaign that was stopped
    python -m tests.hard_cases.hostile.campaign 10000 --keep FOLDER --readers EXR PNG
    python -m tests.hard_cases.hostile.campaign 0 --keep FOLDER --write  write the table into the document

Readers take turns, a chunk of inputs each, so a campaign that is stopped early has tried them evenly.
Several campaigns with different readers may use one folder at a time.
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
CHUNK = 250
"""Inputs of a reader between two saves."""


@dataclass
class Progress:
    """The outcomes of the inputs of each reader so far, and their number."""

    outcomes: dict[str, Outcome] = field(default_factory=dict)
    done: dict[str, int] = field(default_factory=dict)

    @staticmethod
    def read(folder: Path) -> Progress:
        """The progress that `write` saved, of all readers."""
        progress = Progress()
        for number, name in enumerate(READERS):
            if (path := folder / f"{number}.json").exists():
                saved = json.loads(path.read_text())
                progress.outcomes[name], progress.done[name] = Outcome(**saved["outcome"]), saved["done"]
        return progress

    def write(self, folder: Path, name: str) -> None:
        """Save the progress of a reader in a file of its own."""
        path = folder / f"{list(READERS).index(name)}.json"
        path.parent.mkdir(parents=True, exist_ok=True)
        temporary = path.with_suffix(".new")
        temporary.write_text(json.dumps({"outcome": asdict(self.outcomes[name]), "done": self.done[name]}))
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


def main(
    count: tyro.conf.Positional[int],
    keep: Path | None = None,
    readers: tuple[str, ...] = tuple(READERS),
    write: bool = False,
) -> int:
    """Read damaged files with every reader; exit status 1 if there is a fault.

    Args:
        count: inputs of a reader, numbered from 0; the same numbers are the same damage.
        keep: folder in which the progress is saved, and from which a stopped campaign continues.
        readers: names of the readers.
        write: put the table into docs/stability.md.
    """
    warnings.simplefilter("ignore")
    progress = Progress.read(keep) if keep else Progress()
    for turn in range(CHUNK, count + CHUNK, CHUNK):
        for name in readers:
            begin, end = progress.done.get(name, 0), min(turn, count)
            if begin >= end:
                continue
            with tempfile.TemporaryDirectory() as folder:
                outcome = attack(READERS[name], Path(folder) / "files", begin, end - begin)
            progress.add(name, end - begin, outcome)
            if keep:
                progress.write(keep, name)
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
