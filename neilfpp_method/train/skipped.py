"""Steps that were skipped because they were not finite, in `RUN/skipped/STEP.pt`: all that it takes to run
one of them again.
"""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from neilfpp_method.data.images import replacing
from neilfpp_method.errors import UserError
from neilfpp_method.model import NeilfModel
from neilfpp_method.schedule import Stage, StagePosition
from neilfpp_method.structures import PixelBatch

__all__ = ["FOLDER", "Moment", "SkippedStep", "keep_step", "load_step"]

FOLDER = "skipped"
MAX_KEPT = 4
"""Steps of a run that are kept, the first ones: a file is as large as the model, and later faults are
mostly the first one again.
"""
FORMAT = 1
KEYS = {"format", "step", "stage", "share", "batch", "model", "random"}


@dataclass(frozen=True)
class Moment:
    """What a step begins with: its pixels, where in its stage it is, the state of the random numbers, and the
    surface points that are remembered, which it changes. The weights are changed at its end alone, and not by
    a step that is skipped.
    """

    batch: PixelBatch
    position: StagePosition
    random: Tensor
    remembered: dict[str, Any]

    @staticmethod
    def before_step(model: NeilfModel, batch: PixelBatch, position: StagePosition) -> Moment:
        """The moment after the pixels of a step are drawn. Where the step shades points of earlier ones too,
        these are copied, some hundred kilobytes.
        """
        remembered = {}
        if not model.stages[position.stage].moves_host:
            state = model.replay.state_dict(prefix="replay.")
            remembered = {name: v.clone() if isinstance(v, Tensor) else dict(v) for name, v in state.items()}
        return Moment(batch, position, torch.get_rng_state(), remembered)


@dataclass(frozen=True)
class SkippedStep:
    """A step to run again.

    Attributes:
        step: its number in the training.
        stage: its stage.
        share: of the stage that was done.
        batch: its pixels and their rays.
        model: the weights that it was computed with, as `NeilfModel.load_state_dict` takes them.
        random: the state of torch's random numbers on the CPU after the pixels were drawn.
    """

    step: int
    stage: Stage
    share: float
    batch: PixelBatch
    model: dict[str, Any]
    random: Tensor


def keep_step(run: Path, model: NeilfModel, moment: Moment, step: int) -> Path | None:
    """Write a step down, unless enough of them are kept already; returns the file.

    Raises:
        UserError: it cannot be written.
    """
    folder = run / FOLDER
    if folder.is_dir() and len(list(folder.glob("*.pt"))) >= MAX_KEPT:
        return None
    contents = {
        "format": FORMAT,
        "step": step,
        "stage": moment.position.stage.value,
        "share": moment.position.share,
        "batch": {f.name: getattr(moment.batch, f.name).cpu() for f in dataclasses.fields(PixelBatch)},
        "model": {**model.state_dict(), **moment.remembered},
        "random": moment.random,
    }
    path = folder / f"{step}.pt"
    with replacing(path) as temporary, temporary.open("wb") as file:
        torch.save(contents, file)
    return path


def load_step(run: Path, step: int) -> SkippedStep:
    """A step that a run has skipped and kept.

    Raises:
        UserError: it is not there, damaged, or of another version.
    """
    path = run / FOLDER / f"{step}.pt"
    if not path.is_file():
        kept = sorted(int(file.stem) for file in (run / FOLDER).glob("*.pt") if file.stem.isdecimal())
        told = f"it has {', '.join(map(str, kept))}" if kept else "it has none: nothing was skipped"
        raise UserError(f"{run}: no skipped step {step} is kept", f"{told} (the first {MAX_KEPT} are kept)")
    try:
        stored = torch.load(path, map_location="cpu", weights_only=True)
    except Exception as error:  # A damaged or forged file can fail anywhere in the unpickler.
        raise UserError(f"{path}: not a step that can be read", "train again") from error
    if not isinstance(stored, dict) or stored.get("format") != FORMAT or KEYS - set(stored):
        raise UserError(f"{path}: a step of another version", "use the version of neilfpp that wrote it")
    try:
        batch, stage = PixelBatch(**stored["batch"]), Stage(stored["stage"])
    except (TypeError, ValueError) as error:
        raise UserError(f"{path}: not a complete step ({error})", "train again") from error
    return SkippedStep(stored["step"], stage, stored["share"], batch, stored["model"], stored["random"])
