"""From measurements of a run to findings: each case with its limit, its likely cause and its remedy.

The limits rest on reasoning and on few runs (docs/health.md): a finding means that something is wrong, its
absence does not mean that all is well.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from typing import Literal

from neilfpp_method.health.look import Look

__all__ = [
    "Finding",
    "Health",
    "Verdict",
    "few_light_points",
    "material_findings",
    "nothing_shaded",
    "skipped_steps",
    "surface_findings",
    "verdict_of",
]

Verdict = Literal["sound", "doubtful", "failed"]

MIN_OPAQUE = 0.05
"""Share of the object's pixels that must show something; an empty scene shows nothing anywhere."""
MIN_SHARP = 0.5
"""Share of opaque rays that must meet one surface; in fog a ray's weight spreads, and few do."""
MAX_AT_BOUND = 0.5
"""Share of the surface that may have a base colour at a bound: a scene of black or white things has less."""
MAX_EMPTY_STEPS = 50
"""Steps of a material stage in a row that may shade nothing."""
MIN_LIGHT_POINTS = 100
"""Surface points from which a light of thousands of texels can be fitted at all."""
MAX_SKIPPED = 0.05
"""Share of the steps that may be skipped for a loss or a gradient that is not finite."""
MIN_STEPS = 100
"""Steps before which a share of skipped steps says nothing."""


@dataclass(frozen=True)
class Finding:
    """Something that is wrong with a run.

    Attributes:
        case: its name, as in docs/health.md.
        severe: the result is of no use; otherwise it is to be doubted.
        step: of the training, where it was found.
        what, cause, remedy: for the person, a clause each.
    """

    case: str
    severe: bool
    step: int
    what: str
    cause: str
    remedy: str

    def line(self) -> str:
        """For the terminal."""
        return f"step {self.step}: {self.what}; likely {self.cause}; {self.remedy}"


def verdict_of(findings: Iterable[Finding]) -> Verdict:
    """The worst of all findings."""
    severe = [finding.severe for finding in findings]
    return "failed" if any(severe) else "doubtful" if severe else "sound"


@dataclass(frozen=True)
class Health:
    """A verdict and what it rests on.

    Attributes:
        verdict: the worst of all findings.
        findings: what is wrong, a case each; none where the verdict is "sound".
    """

    verdict: Verdict
    findings: tuple[Finding, ...]

    @staticmethod
    def of(findings: Iterable[Finding]) -> Health:
        """The health that findings come to."""
        found = tuple(findings)
        return Health(verdict_of(found), found)

    def __str__(self) -> str:
        return self.verdict + (": " + "; ".join(f.what for f in self.findings) if self.findings else "")


def surface_findings(seen: Look, step: int) -> list[Finding]:
    """What a look says of the surface, at the end of a stage that moves it or later."""
    if seen.opaque < MIN_OPAQUE:
        return [
            Finding(
                "no_surface",
                True,
                step,
                f"{seen.opaque:.0%} of the object's pixels show anything at all",
                "a scene box that misses the object, or masks that are inverted",
                "look at the picture of `neilfpp inspect`",
            )
        ]
    if seen.sharp < MIN_SHARP:
        return [
            Finding(
                "fog",
                True,
                step,
                f"only {seen.sharp:.0%} of the rays that show something meet one surface: the scene is fog",
                "a scene box that holds the cameras, or too few views, steps or masks",
                "look at `neilfpp inspect`, give masks, or more --config.train.sdf-steps",
            )
        ]
    return []


def material_findings(seen: Look, step: int) -> list[Finding]:
    """What a look says of the material."""
    if seen.at_bound is None or seen.at_bound <= MAX_AT_BOUND:
        return []
    return [
        Finding(
            "material_at_bounds",
            False,
            step,
            f"the base colour of {seen.at_bound:.0%} of the surface is black or white",
            "a light whose scale is off",
            "give the light with --light, or look at docs/light.md",
        )
    ]


def nothing_shaded(steps: int, step: int) -> list[Finding]:
    """What it means that `steps` steps in a row had no surface point to shade."""
    if steps < MAX_EMPTY_STEPS:
        return []
    return [
        Finding(
            "nothing_shaded",
            True,
            step,
            f"no surface point was shaded for {steps} steps, so material and light learn nothing",
            "a surface that never condensed",
            "look at the preview of SDF init in the run's folder",
        )
    ]


def few_light_points(points: int, step: int) -> list[Finding]:
    """What it means that the light was fitted to so many points."""
    if points >= MIN_LIGHT_POINTS:
        return []
    return [
        Finding(
            "few_light_points",
            False,
            step,
            f"the light was fitted to {points} surface points; nothing is said of lamps",
            "masks or a surface that leave few pixels to shade",
            "look at the previews, or take more --config.train.rays",
        )
    ]


def skipped_steps(skipped: int, step: int) -> list[Finding]:
    """What it means that so many of `step` steps were skipped."""
    if step < MIN_STEPS or skipped <= MAX_SKIPPED * step:
        return []
    return [
        Finding(
            "skipped_steps",
            False,
            step,
            f"{skipped} of {step} steps were skipped, as they were not finite",
            "pixels far above the rest, or learning rates that are too high",
            "look at `neilfpp inspect` for the brightest pixels",
        )
    ]
