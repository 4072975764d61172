"""Store skipped steps, which were not finite, in `RUN/skipped/STEP.pt`, so that they can be run again."""

from __future__ import annotations

import dataclasses
import shlex
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from neilfpp_method.data.files.atomic_file import replacing
from neilfpp_method.errors import UserError
from neilfpp_method.model import NeilfModel
from neilfpp_method.schedule import Stage, StagePosition
from neilfpp_method.structures import PixelBatch
from neilfpp_method.train.tensor_file import read_tensor_file

__all__ = ["FOLDER", "Moment", "SkippedStep", "keep_step", "keep_with_note", "load_step"]

FOLDER = "skipped"
MAX_KEPT = 4
"""Maximum number of stored steps of a run, the first ones. A file is as large as the model, and later steps
mostly fail for the same reason as the first.
"""
FORMAT = 1
"""Version of the layout of a file."""
KEYS = {"format", "step", "stage", "share", "batch", "model", "random"}
"""Keys of a file."""


@dataclass(frozen=True)
class Moment:
    """The state before a training step, apart from the weights, which a skipped step does not change.

    Attributes:
        batch: the pixels of the step.
        position: the stage and the position within it.
        step: number of the step, counted over all stages.
        random: state of torch's random number generator on the CPU.
    """

    batch: PixelBatch
    position: StagePosition
    step: int
    random: Tensor

    @staticmethod
    def before_step(batch: PixelBatch, position: StagePosition, step: int) -> Moment:
        """Record the state after the pixels of a step are drawn."""
        return Moment(batch, position, step, torch.get_rng_state())


@dataclass(frozen=True)
class SkippedStep:
    """A step to run again.

    Attributes:
        step: number of the step.
        stage: its stage.
        share: share of the stage that was trained before it.
        batch: its pixels and their rays.
        model: the weights of the model, as `NeilfModel.load_state_dict` takes them.
        random: state of torch's random number generator on the CPU after the pixels were drawn.
    """

    step: int
    stage: Stage
    share: float
    batch: PixelBatch
    model: dict[str, Any]
    random: Tensor


def keep_step(run: Path, model: NeilfModel, moment: Moment) -> Path | None:
    """Store a step unless `MAX_KEPT` steps are stored already.

    Returns:
        The file; None if the step is not stored.

    Raises:
        UserError: if the file cannot be written.
    """
    folder = run / FOLDER
    if folder.is_dir() and len(list(folder.glob("*.pt"))) >= MAX_KEPT:
        return None
    contents = {
        "format": FORMAT,
        "step": moment.step,
        "stage": moment.position.stage.value,
        "share": moment.position.share,
        "batch": {f.name: getattr(moment.batch, f.name).cpu() for f in dataclasses.fields(PixelBatch)},
        "model": model.state_dict(),
        "random": moment.random,
    }
    path = folder / f"{moment.step}.pt"
    with replacing(path) as temporary, temporary.open("wb") as file:
        torch.save(contents, file)
    return path


def keep_with_note(run: Path, model: NeilfModel, moment: Moment) -> str:
    """Store a step as `keep_step` does, and return the end of the message that reports it.

    A full disk is reported in the message and does not stop the training.
    """
    try:
        kept = keep_step(run, model, moment)
    except UserError as error:
        return f"; the step is not stored: {error.problem}"
    return f"; see neilfpp replay {shlex.quote(str(run))} {moment.step}" if kept else ""


def load_step(run: Path, step: int) -> SkippedStep:
    """Read a stored step of a run.

    Raises:
        UserError: if the file is missing, damaged, or of another version.
    """
    path = run / FOLDER / f"{step}.pt"
    if not path.is_file():
        stored_steps = sorted(int(file.stem) for file in (run / FOLDER).glob("*.pt") if file.stem.isdecimal())
        if stored_steps:
            remedy = f"choose one of {', '.join(map(str, stored_steps))} (the first {MAX_KEPT} are stored)"
        else:
            remedy = "the run has skipped no step, so there is nothing to replay"
        raise UserError(f"{run}: step {step} is not a stored skipped step", remedy)
    try:
        stored = read_tensor_file(path)
    except Exception as error:
        # A damaged or forged file can raise any exception in the unpickler.
        raise UserError(f"{path}: not a readable step", "train again") from error
    if not isinstance(stored, dict) or stored.get("format") != FORMAT or KEYS - set(stored):
        raise UserError(f"{path}: a step of another version", "use the version of neilfpp that wrote it")
    try:
        return _checked(stored)
    except (TypeError, ValueError, RuntimeError) as error:
        raise UserError(f"{path}: not a complete step ({error})", "train again") from error


def _checked(stored: dict[str, Any]) -> SkippedStep:
    """The step of a file, whose values may be of any type.

    Raises:
        TypeError, ValueError, RuntimeError: a value is not one that `keep_step` writes.
    """
    batch, stage = PixelBatch(**stored["batch"]), Stage(stored["stage"])
    for field in dataclasses.fields(batch):
        values, whole_numbers = getattr(batch, field.name), field.name == "view"
        width = (3,) if field.name in ("origins", "directions", "color") else ()
        if not isinstance(values, Tensor) or values.shape != (len(batch.view), *width):
            raise ValueError(f"{field.name} has another shape than the rays")
        if values.dtype != (torch.int64 if whole_numbers else torch.float32):
            raise ValueError(f"{field.name} has the type {values.dtype}")
    torch.Generator().set_state(stored["random"])
    if not isinstance(stored["step"], int) or not isinstance(stored["model"], dict):
        raise ValueError("the number of the step or the weights are missing")
    share = float(stored["share"])
    if not 0 <= share <= 1:
        raise ValueError(f"share is {share}")
    return SkippedStep(stored["step"], stage, share, batch, stored["model"], stored["random"])
