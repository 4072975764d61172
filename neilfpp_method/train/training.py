"""The state of a training in progress, which the parts of the loop share."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path

from lightning_fabric import Fabric

from neilfpp_method.data.capture import Capture
from neilfpp_method.data.pixels.dataset import PixelDataset
from neilfpp_method.effects.plan import Plan
from neilfpp_method.health.watch import Watch
from neilfpp_method.lighting.solver import LightSolver
from neilfpp_method.model import NeilfModel
from neilfpp_method.schedule import Stage
from neilfpp_method.settings.types import NeilfConfig
from neilfpp_method.timing.ledger import Ledger
from neilfpp_method.train.light_record import LightFit
from neilfpp_method.train.pace import Pace
from neilfpp_method.train.poses import GivenCameras
from neilfpp_method.train.progress import Reporter
from neilfpp_method.train.quality import Quality

__all__ = ["Training"]


@dataclass
class Training:
    """The state of a run in progress.

    Attributes:
        path: the run folder.
        config: the settings, with the current numbers of steps.
        model: the model.
        pixels: the training pixels, with the current poses of the cameras.
        fabric: device and processes.
        reporter: progress output.
        should_stop: whether a stop has been requested; called once per step.
        preview: writes the preview picture at the end of a stage.
        continue_with: command line that continues the run after a stop.
        light_solver: fits the light.
        watch: health checks.
        plan: the effects that are simulated.
        quality: measurements at held-back pixels.
        ledger: the clock.
        pace: adapts the number of steps to a time budget; None without a budget.
        fits: results of the fits of the light so far.
        skipped: number of steps skipped so far because they were not finite.
        skipped_in_a_row: number of steps skipped since the last one that was not.
        seconds: time of each stage.
        given: the pixels with the poses as given.
    """

    path: Path
    config: NeilfConfig
    model: NeilfModel
    pixels: PixelDataset
    fabric: Fabric
    reporter: Reporter
    should_stop: Callable[[], bool]
    preview: Callable[[NeilfModel, Capture, Stage], None]
    continue_with: str
    light_solver: LightSolver
    watch: Watch
    plan: Plan
    quality: Quality
    ledger: Ledger = field(default_factory=Ledger)
    pace: Pace | None = None
    fits: list[LightFit] = field(default_factory=list)
    skipped: int = 0
    skipped_in_a_row: int = 0
    seconds: dict[str, float] = field(default_factory=dict)
    given: GivenCameras = field(init=False)

    def __post_init__(self) -> None:
        self.given = GivenCameras(self.pixels, self.quality.pixels, self.watch.pixels)
