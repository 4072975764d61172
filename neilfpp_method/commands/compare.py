"""`neilfpp compare`."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import tyro

from neilfpp_method.commands.command import Command, Device, progress_bar, terminal

__all__ = ["COMMAND"]


@dataclass
class Compare:
    """Set runs side by side: what differs in their settings, figures, seconds, and the same views of all."""

    runs: tyro.conf.Positional[tuple[Path, ...]]
    """The folders of two runs or more, of one capture; the first is what the others are compared with."""
    out: Path = Path("comparison")
    """Where compare.json, compare.csv and compare.png go."""
    views: int = 2
    """How many views are rendered for the picture; 0: none, a table alone."""
    size: int = 320
    """Pixels of the longest side of a rendered view, and no more than every run was trained at."""
    device: Device = "auto"
    """Where to render."""


def run(options: Compare) -> None:
    from neilfpp_method.compare.terminal import tables_of
    from neilfpp_method.compare.write import compare_runs
    from neilfpp_method.kernels.process import computing_fast
    from neilfpp_method.train.device import pick_device

    with computing_fast(), progress_bar("comparing") as advance:
        found = compare_runs(
            options.runs,
            options.out,
            options.views,
            options.size,
            str(pick_device(options.device)),
            advance,
        )
    console = terminal()
    for title, table, notes in tables_of(found):
        console.print(f"\n{title}", style="bold", soft_wrap=True)
        console.print(table)
        for note in notes:
            console.print(f"* {note}", soft_wrap=True)
    for note in found.notes:
        console.print(f"* {note}", soft_wrap=True)
    for file in found.files:
        console.print(f"written to {file}", soft_wrap=True)


COMMAND = Command(
    Compare,
    run,
    [
        "neilfpp compare runs/fast runs/paper",
        "neilfpp compare runs/lamps runs/no-lamps --views 4 --out lamps-or-not",
        "neilfpp compare runs/a runs/b runs/c --views 0   (the table alone, at once)",
    ],
)
