"""Checkpoints of a run: the state of model, light solver and optimizer after a number of steps."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import torch
from torch import nn

from neilfpp_method.data.files.atomic_file import replacing
from neilfpp_method.errors import UserError
from neilfpp_method.train.tensor_file import read_tensor_file

__all__ = [
    "FORMAT",
    "LAST",
    "checkpoint_path",
    "last_checkpoint",
    "load_checkpoint",
    "load_weights",
    "save_checkpoint",
]

FORMAT = 11
"""Version of the layout of a run folder and of its checkpoints."""
LAST = "last"
"""Name of the newest checkpoint; every other one has the name of the stage that it ends."""
KEYS = {"format", "step", "model", "light_solver", "optimizer"}
"""Keys of a checkpoint."""


def checkpoint_path(run: Path, name: str) -> Path:
    """The file of a checkpoint of a run: `LAST`, or the name of a stage for its end."""
    return run / "checkpoints" / f"{name}.pt"


def last_checkpoint(run: Path) -> Path:
    """The file of the newest checkpoint of a run, from which it continues."""
    return checkpoint_path(run, LAST)


def save_checkpoint(
    path: Path, model: nn.Module, light_solver: nn.Module, optimizer: torch.optim.Optimizer, step: int
) -> None:
    """Write the state of model, light solver and optimizer after `step` steps, atomically."""
    parts = {"model": model, "light_solver": light_solver, "optimizer": optimizer}
    contents = {"format": FORMAT, "step": step, **{name: part.state_dict() for name, part in parts.items()}}
    with replacing(path) as temporary, temporary.open("wb") as file:
        try:
            torch.save(contents, file)
        except RuntimeError as error:
            # If the disk is full, torch raises an error that hides the original one.
            if isinstance(error.__context__, OSError):
                raise error.__context__ from None
            raise


def load_checkpoint(path: Path) -> dict[str, Any]:
    """Read a checkpoint. A file that contains anything but tensors and plain values is rejected.

    Raises:
        UserError: if the file is missing, unreadable, or of another version.
    """
    if not path.is_file():
        raise UserError(f"{path}: no checkpoint", "train the run first, or continue it with --resume")
    try:
        contents = read_tensor_file(path)
    except Exception as error:
        # A damaged or forged file can raise any exception in the unpickler.
        remedy = "copy a stage's checkpoint over it, or train again"
        raise UserError(f"{path}: not a readable checkpoint", remedy) from error
    if not isinstance(contents, dict) or contents.get("format") != FORMAT or KEYS - set(contents):
        raise UserError(
            f"{path}: a checkpoint of another version", "use the version of neilfpp that wrote it"
        )
    return contents


def load_weights(module: nn.Module, weights: Mapping[str, Any], run: Path) -> None:
    """Load weights of a checkpoint into a model or a light solver.

    Raises:
        UserError: if they do not fit, because the settings, the capture or the mesh of the run have been
            changed.
    """
    try:
        module.load_state_dict(weights)
    except UserError as error:
        raise UserError(f"{run}: {error.problem}", error.remedy) from error
    except (RuntimeError, TypeError) as error:
        raise UserError(
            f"{run}: the checkpoint does not fit the settings in config.json",
            "restore that file, or use the version of neilfpp that wrote the run",
        ) from error
