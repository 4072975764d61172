"""`neilfpp compare`."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import tyro

from neilfpp_method.commands.command import Command, Device, progress_bar, terminal

__all__ = ["COMMAND"]


@dataclass
class Compare:
    """Compare runs of one capture: differing settings, metrics, times, and renderings of the same views."""

    runs: tyro.conf.Positional[tuple[Path, ...]]
    """Two or more run folders; the others are compared with the first."""
    out: Path = Path("comparison")
    """Folder for compare.json, compare.csv and compare.png."""
    views: int = 2
    """Number of views to render for the picture; 0 for tables only."""
    size: int = 320
    """Longest side of a rendered view in pixels, at most the size that every run was trained at."""
    device: Device = "auto"
    """Device to render on."""


def run(options: Compare) -> None:
    from neilfpp_method.compare.terminal import printed_parts
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
    for part in printed_parts(found):
        console.print(f"\n{part.title}", style="bold", soft_wrap=True)
        console.print(part.table)
        for note in part.notes:
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
        "neilfpp compare runs/a runs/b runs/c --views 0   (tables only, without rendering)",
    ],
)
