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
    device: Device = "auto"
    """Where to compute."""


def run(options: Eval) -> None:
    from neilfpp_method.evaluate.protocols import evaluate, write_metrics
    from neilfpp_method.kernels.process import computing_fast
    from neilfpp_method.train.device import pick_device
    from neilfpp_method.train.run import check_writable, load_run

    run = load_run(options.run, pick_device(options.device), options.checkpoint)
    out = options.out or options.run / "metrics.json"
    check_writable(out)
    with computing_fast(), progress_bar("evaluating") as advance:
        metrics = evaluate(run, advance)
    write_metrics(out, run, metrics)
    console = terminal()
    for name, value in metrics.items():
        console.print(f"{name:36} {value:8.3f}")
    console.print(f"written to {out}", soft_wrap=True)


COMMAND = Command(
    Eval,
    run,
    ["neilfpp eval runs/teapot", "neilfpp eval runs/teapot --checkpoint material_init --out sep.json"],
)
