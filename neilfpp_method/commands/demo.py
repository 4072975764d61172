"""`neilfpp demo`."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

from neilfpp_method.commands.command import Command, Device, terminal

__all__ = ["COMMAND"]


@dataclass
class Demo:
    """Train on the scene in the package and write a report to look at."""

    out: Path = Path("demo-run")
    """Where the run and its report go."""
    resume: bool = False
    """Continue a demo that was stopped."""
    short: bool = False
    """A twentieth of the steps: shows that everything runs, not what it can do."""
    device: Device = "auto"
    """Where to compute."""


def run(options: Demo) -> None:
    from neilfpp_method.demo.command import run_demo
    from neilfpp_method.kernels.process import computing_fast

    with computing_fast():
        run_demo(
            options.out, short=options.short, resume=options.resume, device=options.device, console=terminal()
        )


COMMAND = Command(Demo, run, ["neilfpp demo", "neilfpp demo --short --out trial"])
