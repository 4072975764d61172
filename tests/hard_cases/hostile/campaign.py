"""The table of damaged files in docs/stability.md.

    python -m tests.hard_cases.hostile.campaign 10000            print it
    python -m tests.hard_cases.hostile.campaign 10000 --write    and write it into the document

The number is that of the inputs of a reader; those whose inputs cost milliseconds get a fifth of it.
"""

from __future__ import annotations

import json
import re
import sys
import tempfile
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import tyro

from tests.hard_cases.hostile.readers import READERS
from tests.hard_cases.hostile.worker import main as attack_all

DOCUMENT = Path(__file__).parents[3] / "docs" / "stability.md"
MARKED = re.compile(r"(<!-- hostile -->\n).*?(<!-- end -->)", re.DOTALL)


def table(outcomes: Mapping[str, Mapping[str, Any]]) -> str:
    """What became of the inputs of each reader, in Markdown."""
    rows = [
        "| reader | inputs | gave a value | refused in one line | faults | memory, MiB |",
        "|---|---|---|---|---|---|",
    ]
    for name, o in outcomes.items():
        inputs = o["read"] + o["refused"]
        figures = (inputs, o["read"], o["refused"], len(o["faults"]), o["grown"] >> 20)
        rows.append(f"| {name} | {' | '.join(f'{figure:,}' for figure in figures)} |")
    total = sum(o["read"] + o["refused"] for o in outcomes.values())
    faults = sum(len(o["faults"]) for o in outcomes.values())
    return "\n".join(rows) + f"\n\n{total:,} inputs, {faults} faults.\n"


def main(count: tyro.conf.Positional[int], first: int = 0, write: bool = False) -> int:
    """Read damaged files with every reader; exit status 1 where there is a fault.

    Args:
        count: inputs of a cheap reader.
        first: number of the first input; the same numbers are the same damage.
        write: put the table into docs/stability.md.
    """
    with tempfile.TemporaryDirectory() as folder:
        report = Path(folder) / "report.json"
        counts = {name: max(1, round(count * reader.share)) for name, reader in READERS.items()}
        attack_all(Path(folder), report, first, counts)
        outcomes = json.loads(report.read_text())
    print(table(outcomes))
    for name, outcome in outcomes.items():
        for number, file, what in outcome["faults"]:
            print(f"{name}, input {number}, {file}: {what}")
    if write:
        command = f"`python -m tests.hard_cases.hostile.campaign {count} --first {first}`"
        told = f"{table(outcomes)}\n{command}\n"
        DOCUMENT.write_text(
            MARKED.sub(lambda m: f"{m[1]}\n{told}{m[2]}", DOCUMENT.read_text("utf-8")), "utf-8"
        )
    return int(any(outcome["faults"] for outcome in outcomes.values()))


if __name__ == "__main__":
    sys.exit(tyro.cli(main))
