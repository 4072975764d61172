"""What the caller of a training wants: the capture, the run folder, the settings and the machine."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

from neilfpp_method.effects.request import EffectRequest
from neilfpp_method.settings.types import NeilfConfig

__all__ = ["TrainingRequest"]


@dataclass(frozen=True)
class TrainingRequest:
    """A run to train from a capture, or an existing run to continue.

    Attributes:
        data: folder of the capture; required unless `resume`.
        out: the run folder; None for `runs/CAPTURE-PRESET`. Required with `resume`.
        config: the settings; None, with `resume`, for those of the run.
        resume: whether to continue an existing run.
        test_every: every how many views one is held out, if the capture does not say; None for the default.
        response: what pixels hold: "linear", "srgb", or "auto" for what the files say.
        format: format of the capture; None to recognise it from the files.
        scale: size of the images relative to their files; None for the largest that the rays of the training
            can use.
        effects: the value of `--effects` (`effects.request`); None for the effects of the settings or, with
            `resume`, of the run.
        budget: time of the whole command, in seconds; None to train as many steps as the settings say or,
            with `resume`, to keep the budget of the run.
        device: name of the device (`train.device`).
        devices: number of processes on this machine, each with a GPU of its own if the device is "cuda".
        nodes: number of machines, each with `devices` processes that torchrun has started.
        strict: whether to raise `Unsound` if the result is unusable.
        command: beginning of the command line that continues a stopped run, for messages.
    """

    data: Path | None = None
    out: Path | None = None
    config: NeilfConfig | None = None
    resume: bool = False
    test_every: int | None = None
    response: str = "auto"
    format: str | None = None
    scale: float | None = None
    effects: EffectRequest | None = None
    budget: float | None = None
    device: str = "auto"
    devices: int = 1
    nodes: int = 1
    strict: bool = False
    command: str = "neilfpp train"

    @property
    def processes(self) -> int:
        """Number of processes on all machines."""
        return self.devices * self.nodes
