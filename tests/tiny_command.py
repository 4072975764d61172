"""The command line with one more preset, `tiny`, for runs in other processes: `python -m tests.tiny_command
train …`. They start from coarse hulls, as in the process of the tests.

With TINY_RECORD=FOLDER every process also writes what it computed: `gradients_RANK.pt` of the first step, as
the optimizer sees them, and `parameters_RANK.pt` at the end.
"""

from __future__ import annotations

import os
import sys
from pathlib import Path

import torch

from neilfpp_method.cli import main
from neilfpp_method.settings.presets import PRESETS
from neilfpp_method.train import command, loop
from tests.coarse_hulls import start_geometry
from tests.train.small_runs import small_config


def record(folder: Path) -> None:
    """Make the training loop write what it computes."""
    rank = os.environ.get("LOCAL_RANK", "0")
    norms, train = loop.gradient_norms, command.train

    def gradient_norms(model):
        path = folder / f"gradients_{rank}.pt"
        if not path.exists():
            torch.save({name: p.grad for name, p in model.named_parameters() if p.grad is not None}, path)
        return norms(model)

    def train_and_save(run):
        train(run)
        torch.save(dict(run.model.named_parameters()), folder / f"parameters_{rank}.pt")

    loop.gradient_norms, command.train = gradient_norms, train_and_save


if __name__ == "__main__":
    PRESETS["tiny"] = small_config
    command.start_geometry = start_geometry
    if "TINY_RECORD" in os.environ:
        record(Path(os.environ["TINY_RECORD"]))
    sys.exit(main())
