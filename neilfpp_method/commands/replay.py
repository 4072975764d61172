"""`neilfpp replay`."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import tyro

from neilfpp_method.commands.command import Command, terminal

__all__ = ["COMMAND"]


@dataclass
class Replay:
    """Repeat a step that training skipped, and name its first operation whose result is not finite."""

    run: tyro.conf.Positional[Path]
    """The run folder."""
    step: tyro.conf.Positional[int]
    """Number of the skipped step, from the warning of the training; a run stores the first four."""


def run(options: Replay) -> None:
    from neilfpp_method.kernels.process import computing_fast
    from neilfpp_method.train.rerun import rerun_step, rerun_summary

    with computing_fast():
        found = rerun_step(options.run, options.step)
    terminal().print(rerun_summary(found), soft_wrap=True)


COMMAND = Command(Replay, run, ["neilfpp replay runs/teapot 1207"])
