"""Plant faults one at a time, and print which quick test notices each.

    python -m benchmarks.mutants            plant all of them, and print the table
    python -m benchmarks.mutants --write    also write it into docs/stability.md
    python -m benchmarks.mutants --only V   plant those whose module or description contains this word
    python -m benchmarks.mutants --part 1 2 plant every second one, so that two processes can share them

The exit status is 1 if a fault is not noticed, or if a test fails without one.
"""

from __future__ import annotations

import sys

import tyro

from benchmarks.mutants.faults import MUTANTS
from benchmarks.mutants.planting import try_all
from benchmarks.mutants.table import table, write_table


def main(write: bool = False, only: str = "", part: tuple[int, int] = (1, 1)) -> int:
    """Plant faults one at a time, and print which quick test notices each.

    Args:
        write: put the table into docs/stability.md; rows of faults that were not planted are left unchanged.
        only: plant only faults whose module or description contains this text.
        part: number of a part, from 1, and the number of parts to which these faults are dealt out.
    """
    number, parts = part
    named = [mutant for mutant in MUTANTS if only in mutant.module or only in mutant.what]
    outcomes = try_all(
        named[number - 1 :: parts],
        lambda v: print(f"{v.mutant.what}: {v.noticed_by or 'NOT NOTICED'}", flush=True),
    )
    caught = sum(outcome.noticed_by is not None for outcome in outcomes)
    print(f"\n{table(outcomes)}\n{caught} of {len(outcomes)} faults are noticed")
    if write:
        write_table(outcomes)
    return int(caught < len(outcomes))


if __name__ == "__main__":
    sys.exit(tyro.cli(main))
