"""`neilfpp demo`."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

from neilfpp_method.commands.command import Command, Device, terminal

__all__ = ["COMMAND"]


@dataclass
class Demo:
    """Train on the example scene of the package and write a report."""

    out: Path = Path("demo-run")
    """Folder for the run and its report."""
    resume: bool = False
    """Continue a demo that was stopped."""
    short: bool = False
    """Train a twentieth of the steps: a test of the installation, without useful results."""
    device: Device = "auto"
    """Device to compute on."""


def run(options: Demo) -> None:
    from neilfpp_method.demo.command import run_demo
    from neilfpp_method.kernels.process import computing_fast

    with computing_fast():
        run_demo(
            options.out, short=options.short, resume=options.resume, device=options.device, console=terminal()
        )


COMMAND = Command(Demo, run, ["neilfpp demo", "neilfpp demo --short --out trial"])
