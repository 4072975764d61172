"""Collect the findings of a training: warn at once, and record the verdict in `RUN/health.json`."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from typing import Any

from neilfpp_method.health.cases import (
    FEW_LIGHT_POINTS,
    FOG,
    MATERIAL_AT_BOUNDS,
    NO_SURFACE,
    NOTHING_SHADED,
    OFF_CLOUD,
    SKIPPED_STEPS,
    Case,
    Finding,
    Health,
    few_light_points,
    material_findings,
    nothing_shaded,
    skipped_steps,
    surface_findings,
)
from neilfpp_method.health.measure import SurfaceMeasurement, measure_surface
from neilfpp_method.model import NeilfModel
from neilfpp_method.schedule import StagePlan
from neilfpp_method.structures import PixelBatch, StepResult

__all__ = ["CHECKED_PIXELS", "FILE", "FORMAT", "Watch"]

FILE = "health.json"
FORMAT = 1
"""Version of the layout of the file."""
CHECKED_PIXELS = 512
"""Number of training pixels that are rendered at the end of a stage: about as many as in a step."""


@dataclass
class Watch:
    """The findings of a training so far. A finding is dropped if a later measurement does not confirm it.

    Attributes:
        pixels: training pixels on the device of the model; None if measurements are passed to `judge`.
        warn: prints a line for the user.
        findings: the findings by case.
        empty_steps: number of consecutive steps so far without a surface point.
    """

    pixels: PixelBatch | None
    warn: Callable[[str], None]
    findings: dict[str, Finding] = field(default_factory=dict)
    empty_steps: int = 0

    def after_step(self, plan: StagePlan, computed: StepResult, step: int) -> None:
        """Check whether a step had surface points to shade."""
        if not plan.trains_material:
            return
        self.empty_steps = 0 if len(computed.surface_rows) else self.empty_steps + 1
        self._replace([NOTHING_SHADED], nothing_shaded(self.empty_steps, step))

    def after_fit(self, points: int, step: int) -> None:
        """Check the number of points to which the light was fitted."""
        self._replace([FEW_LIGHT_POINTS], few_light_points(points, step))

    def after_stage(self, model: NeilfModel, plan: StagePlan, skipped: int, step: int) -> None:
        """Measure and check the surface, and the material in a stage that trains it."""
        self.judge(measure_surface(model, self.pixels, plan.trains_material), skipped, step)

    def judge(self, measured: SurfaceMeasurement, skipped: int, step: int) -> None:
        """Check a measurement and the number of steps skipped so far."""
        self._replace([NO_SURFACE, FOG, OFF_CLOUD], surface_findings(measured, step))
        self._replace([MATERIAL_AT_BOUNDS], material_findings(measured, step))
        self._replace([SKIPPED_STEPS], skipped_steps(skipped, step))

    def _replace(self, cases: Sequence[Case], findings: Sequence[Finding]) -> None:
        """Replace the findings of some cases, and warn of those that are new."""
        before = {case.name: self.findings.pop(case.name) for case in cases if case.name in self.findings}
        for finding in findings:
            if finding.case not in before:
                self.warn(finding.line())
            self.findings[finding.case] = before.get(finding.case, finding)

    @property
    def health(self) -> Health:
        """The verdict that follows from the findings so far."""
        return Health.of(self.findings.values())

    def record(self) -> dict[str, Any]:
        """The content of `health.json`."""
        findings = [dataclasses.asdict(finding) for finding in self.findings.values()]
        return {"format": FORMAT, "verdict": self.health.verdict, "findings": findings}
