"""Follows a training: warns at once, and leaves a verdict in `RUN/health.json`."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from typing import Any

from neilfpp_method.health.cases import (
    Finding,
    few_light_points,
    material_findings,
    nothing_shaded,
    skipped_steps,
    surface_findings,
    verdict_of,
)
from neilfpp_method.health.look import Look, look
from neilfpp_method.model import NeilfModel
from neilfpp_method.schedule import StagePlan
from neilfpp_method.structures import PixelBatch, StepResult

__all__ = ["FILE", "FORMAT", "LOOKED_AT", "Watch"]

FILE = "health.json"
FORMAT = 1
LOOKED_AT = 512
"""Training pixels that are rendered for a look at the end of a stage: as many as a step has."""


@dataclass
class Watch:
    """The findings of a training so far, by case; what a later look finds mended is dropped.

    Attributes:
        pixels: of training views, on the device of the model; none where looks are handed in (`judge`).
        warn: says a line to the person.
    """

    pixels: PixelBatch | None
    warn: Callable[[str], None]
    findings: dict[str, Finding] = field(default_factory=dict)
    empty_steps: int = 0

    def after_step(self, plan: StagePlan, computed: StepResult, step: int) -> None:
        """What the step shaded; costs nothing."""
        if not plan.moves_material:
            return
        self.empty_steps = 0 if len(computed.surface_rows) else self.empty_steps + 1
        self._replace(("nothing_shaded",), nothing_shaded(self.empty_steps, step))

    def after_fit(self, points: int, step: int) -> None:
        """How many points the light was fitted to."""
        self._replace(("few_light_points",), few_light_points(points, step))

    def after_stage(self, model: NeilfModel, plan: StagePlan, skipped: int, step: int) -> None:
        """A look at the surface, and at its material where there is one."""
        self.judge(look(model, self.pixels, plan.moves_material), skipped, step)

    def judge(self, seen: Look, skipped: int, step: int) -> None:
        """What a look says, and so many skipped steps."""
        self._replace(("no_surface", "fog"), surface_findings(seen, step))
        self._replace(("material_at_bounds",), material_findings(seen, step))
        self._replace(("skipped_steps",), skipped_steps(skipped, step))

    def _replace(self, cases: Sequence[str], found: Sequence[Finding]) -> None:
        known = {case: self.findings.pop(case) for case in cases if case in self.findings}
        for finding in found:
            if finding.case not in known:
                self.warn(finding.line())
            self.findings[finding.case] = known.get(finding.case, finding)

    def record(self) -> dict[str, Any]:
        """For `health.json`."""
        found = [dataclasses.asdict(finding) for finding in self.findings.values()]
        return {"format": FORMAT, "verdict": verdict_of(self.findings.values()), "findings": found}
