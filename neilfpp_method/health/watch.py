"""Collect the findings of a training: warn at once, and record the verdict in `RUN/health.json`."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from typing import Any

from neilfpp_method.health.cases import (
    BETA_STUCK,
    FEW_LIGHT_POINTS,
    FOG,
    MATERIAL_AT_BOUNDS,
    METALLIC_AT_BOUND,
    NO_SURFACE,
    NOTHING_SHADED,
    OFF_CLOUD,
    ROUGHNESS_AT_BOUND,
    SKIPPED_STEPS,
    WORSE_THAN_CONSTANT,
    Case,
    Finding,
    Health,
    few_light_points,
    material_findings,
    nothing_shaded,
    skipped_steps,
    surface_findings,
    worse_than_constant,
)
from neilfpp_method.health.measure import HeldBack, SurfaceMeasurement, measure_hits, measure_surface
from neilfpp_method.model import NeilfModel
from neilfpp_method.schedule import Stage, StagePlan, StagePosition
from neilfpp_method.structures import PixelBatch, StepResult

__all__ = ["CHECKED_PIXELS", "FILE", "FORMAT", "Watch"]

FILE = "health.json"
FORMAT = 1
"""Version of the layout of the file."""
CHECKED_PIXELS = 512
"""Number of training pixels that are rendered at the end of a stage: about as many as in a step."""
SURFACE_FROM = 0.5
"""Share of SDF init from which a surface should exist. In trainings of a ball with the bound of β of `fast`,
the rays were sharp from 0.34 on.
"""
SURFACE = (NO_SURFACE, BETA_STUCK, FOG, OFF_CLOUD)
"""Cases of which a measurement of the surface finds at most one."""
MATERIAL = (MATERIAL_AT_BOUNDS, ROUGHNESS_AT_BOUND, METALLIC_AT_BOUND)
"""Cases that a measurement of the material finds."""


@dataclass
class Watch:
    """The findings of a training so far. A finding is dropped if a later measurement does not confirm it.

    Attributes:
        pixels: training pixels on the device of the model; None if measurements are passed to `judge`.
        warn: prints a warning for the user.
        say: prints a line of information for the user.
        findings: the findings by case.
        empty_steps: number of consecutive steps so far without a surface point.
    """

    pixels: PixelBatch | None
    warn: Callable[[str], None]
    say: Callable[[str], None]
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

    def after_check(self, model: NeilfModel, position: StagePosition, held_back: HeldBack, step: int) -> None:
        """Check what was measured at held-back pixels: the surface in SDF init, the rendering after a stage.

        Args:
            model: the model.
            position: the stage, and the number of its steps trained so far.
            held_back: the measurement.
            step: number of steps trained so far in all stages.
        """
        if position.step == position.length:
            self._replace([WORSE_THAN_CONSTANT], worse_than_constant(held_back, step))
        elif position.stage is Stage.SDF_INIT and position.share >= SURFACE_FROM:
            self._replace(SURFACE, surface_findings(measure_hits(model, held_back.hits, False), step))

    def after_stage(self, model: NeilfModel, plan: StagePlan, skipped: int, step: int) -> None:
        """Measure and check the surface, and the material in a stage that trains it."""
        self.judge(measure_surface(model, self.pixels, plan.trains_material), skipped, step)

    def judge(self, measured: SurfaceMeasurement, skipped: int, step: int) -> None:
        """Check a measurement and the number of steps skipped so far."""
        self._replace(SURFACE, surface_findings(measured, step))
        self._replace(MATERIAL, material_findings(measured, step))
        self._replace([SKIPPED_STEPS], skipped_steps(skipped, step))

    def _replace(self, cases: Sequence[Case], findings: Sequence[Finding]) -> None:
        """Replace the findings of some cases; warn of new ones, and say which are no longer found."""
        before = {case.name: self.findings.pop(case.name) for case in cases if case.name in self.findings}
        for finding in findings:
            known = before.pop(finding.case, None)
            if known is None or known.severe != finding.severe:
                self.warn(finding.line())
                known = finding
            self.findings[finding.case] = dataclasses.replace(finding, step=known.step)
        for finding in before.values():
            self.say(f"recovered after step {finding.step}: {finding.case} is no longer found")

    @property
    def health(self) -> Health:
        """The verdict that follows from the findings so far."""
        return Health.of(self.findings.values())

    def record(self) -> dict[str, Any]:
        """The content of `health.json`."""
        findings = [dataclasses.asdict(finding) for finding in self.findings.values()]
        return {"format": FORMAT, "verdict": self.health.verdict, "findings": findings}
