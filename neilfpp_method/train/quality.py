"""Measure the quality of a training while it runs, at held-back pixels (`data.pixels.held_back`).

The pixels are rendered as evaluation renders test views, and the PSNR is computed like `volume_psnr` and
`pbr_psnr`, from clipped values encoded as sRGB. A check is made after every tenth of a stage, but at least
`MIN_STEPS` steps after the previous check, and at the end of each stage. Checks within a stage are postponed
while all checks together have taken more than `MAX_SHARE` of the time of the run. The record is
`RUN/quality.json`; its key `checks` holds the checks.
"""

from __future__ import annotations

import dataclasses
import math
import time
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path

import torch
from jaxtyping import Float
from torch import Tensor

from neilfpp_method.data.files.json_entry import write_json
from neilfpp_method.errors import UserError
from neilfpp_method.health.measure import HeldBack
from neilfpp_method.model import NeilfModel
from neilfpp_method.schedule import StagePosition
from neilfpp_method.shading.color import display_values, tone_map
from neilfpp_method.structures import Maps, PixelBatch, SurfaceHits
from neilfpp_method.train.json_files import is_finite_number, read_entries

__all__ = ["FILE", "Quality", "QualityCheck", "has_checks", "read_checks", "write_checks"]

FORMAT = 1
FILE = "quality.json"
CHECKS_PER_STAGE = 10
"""Number of measurements per stage."""
MIN_STEPS = 200
"""Minimum number of steps between two measurements in a stage; each costs about as much as a step."""
MAX_SHARE = 0.015
"""Share of the time of the run above which measurements within a stage are postponed."""


@dataclass(frozen=True)
class QualityCheck:
    """A measurement at the held-back pixels.

    Attributes:
        step: number of steps trained so far.
        stage: the current stage.
        seconds: time of the run so far.
        radiance: PSNR of R, dB.
        physical: PSNR of the PBR rendering, dB; None before there is a material.
        took: time of the measurement, in seconds.
    """

    step: int
    stage: str
    seconds: float
    radiance: float
    physical: float | None
    took: float


@dataclass
class Quality:
    """The measurements of a training so far.

    Attributes:
        pixels: the held-back pixels; if the capture is too small to hold any back, nothing is measured.
        checks: the measurements in order.
    """

    pixels: PixelBatch
    checks: list[QualityCheck] = field(default_factory=list)

    def check_when_due(
        self, model: NeilfModel, position: StagePosition, step: int, seconds: float
    ) -> HeldBack | None:
        """Measure the quality if a measurement is due.

        Args:
            model: the model; its training mode is left unchanged.
            position: the stage, the number of its steps trained so far, and its length.
            step: number of steps trained so far in all stages.
            seconds: time of the run so far.

        Returns:
            What was measured, for the health checks; None without a measurement, or if it is not finite.
        """
        if not len(self.pixels) or not self._due(position, step, seconds):
            return None
        began = time.perf_counter()
        with torch.no_grad(), model.evaluating():
            hits = model.host.render(self.pixels.rays)
            psnr = _measure(model, self.pixels, hits, model.stages[position.stage].trains_material)
        took = time.perf_counter() - began
        # A model that is not finite is reported by `health`.
        if not (math.isfinite(psnr.radiance) and math.isfinite(psnr.physical or 0.0)):
            return None
        stage = position.stage.value
        self.checks.append(QualityCheck(step, stage, seconds, psnr.radiance, psnr.physical, took))
        shown = display_values(self.pixels.color, model.facts.response)
        return HeldBack(hits, psnr.physical, _psnr(shown.mean(0).expand_as(shown), shown))

    def _due(self, position: StagePosition, step: int, seconds: float) -> bool:
        if position.step == position.length:
            return True
        before = max((check.step for check in self.checks), default=0)
        since = min(step - before, position.step)
        cheap = sum(check.took for check in self.checks) <= MAX_SHARE * seconds
        return cheap and since >= max(MIN_STEPS, math.ceil(position.length / CHECKS_PER_STAGE))


@dataclass(frozen=True)
class _Measured:
    """PSNR of R, and of the PBR rendering if there is a material, in dB."""

    radiance: float
    physical: float | None


def _measure(model: NeilfModel, pixels: PixelBatch, hits: SurfaceHits, with_material: bool) -> _Measured:
    maps = model.maps(pixels.rays, hits) if with_material else Maps.of_host(pixels.rays, hits)
    photograph = display_values(pixels.color, model.facts.response)
    physical = _psnr(tone_map(maps.rgb), photograph) if with_material else None
    return _Measured(_psnr(tone_map(maps.rgb_volume), photograph), physical)


def _psnr(rendered: Float[Tensor, "N 3"], photograph: Float[Tensor, "N 3"]) -> float:
    return -10.0 * math.log10(max(float((rendered - photograph).square().mean()), 1e-10))


def write_checks(run: Path, quality: Quality) -> None:
    """Write the measurements so far, and the number of held-back pixels, into the run folder."""
    checks = [dataclasses.asdict(check) for check in quality.checks]
    write_json(run / FILE, {"format": FORMAT, "pixels": len(quality.pixels), "checks": checks})


def has_checks(run: Path) -> bool:
    """Whether a run has a record of held-back pixels."""
    return (run / FILE).exists()


def read_checks(run: Path, before: int | None = None) -> Sequence[QualityCheck]:
    """Read the measurements of a run.

    Args:
        run: the run folder.
        before: number of steps up to which measurements are wanted; None for all.

    Returns:
        The measurements; empty if the run has no record.

    Raises:
        UserError: if the file is damaged or of another version.
    """
    path = run / FILE
    checks = read_entries(path, FORMAT, "checks", QualityCheck) or []
    if not all(
        is_finite_number(n)
        for check in checks
        for n in (check.seconds, check.radiance, check.physical or 0.0)
    ):
        raise UserError(f"{path}: a number that is not finite", "remove the file, or train again")
    return [check for check in checks if before is None or check.step <= before]
