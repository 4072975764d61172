"""`neilfpp eval`."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import tyro

from neilfpp_method.commands.command import Checkpoint, Command, Device, progress_bar, terminal

__all__ = ["COMMAND"]


@dataclass
class Eval:
    """Measure a run on its test views; writes RUN/metrics.json."""

    run: tyro.conf.Positional[Path]
    """The run's folder."""
    checkpoint: Checkpoint = "last"
    """Which weights."""
    out: Path | None = None
    """Where the figures go; none: RUN/metrics.json."""
    scale: float | None = None
    """Size of the views over that of their files; 1: every pixel. None: 131 thousand pixels a view, about 420×310, and no
    more than the run was trained at."""
    width: int | None = None
    """Width of the views in pixels, in place of --scale."""
    device: Device = "auto"
    """Where to compute."""


def run(options: Eval) -> None:
    from neilfpp_method.evaluate.protocols import evaluate, write_metrics
    from neilfpp_method.evaluate.size import at_size, size_in_words
    from neilfpp_method.kernels.process import computing_fast
    from neilfpp_method.train.device import pick_device
    from neilfpp_method.train.run import check_writable, load_run

    run = at_size(load_run(options.run, pick_device(options.device), options.checkpoint), options.scale, options.width)
    out = options.out or options.run / "metrics.json"
    check_writable(out)
    console = terminal()
    if size := size_in_words(run):
        console.print(size, soft_wrap=True)
    with computing_fast(), progress_bar("evaluating") as advance:
        metrics = evaluate(run, advance)
    write_metrics(out, run, metrics)
    for name, value in metrics.items():
        console.print(f"{name:36} {value:8.3f}")
    console.print(f"written to {out}", soft_wrap=True)


COMMAND = Command(
    Eval,
    run,
    ["neilfpp eval runs/teapot", "neilfpp eval runs/teapot --checkpoint material_init --out sep.json"],
)
