"""The cases of a training that goes wrong: each has a limit, a likely cause and a remedy.

Remedies name settings, which `neilfpp train` takes as `--config.train.sdf-steps` and so on, because users of
`attach_neilf` have no command line.

The limits are based on reasoning and on a few runs (docs/health.md). A finding means that something is wrong;
its absence does not prove that the result is good.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass, replace
from typing import Literal

from neilfpp_method.health.measure import HeldBack, SurfaceMeasurement

__all__ = [
    "BETA_STUCK",
    "FEW_LIGHT_POINTS",
    "FOG",
    "MATERIAL_AT_BOUNDS",
    "METALLIC_AT_BOUND",
    "NOTHING_SHADED",
    "NO_SURFACE",
    "OFF_CLOUD",
    "ROUGHNESS_AT_BOUND",
    "SKIPPED_STEPS",
    "WORSE_THAN_CONSTANT",
    "Case",
    "Finding",
    "Health",
    "Verdict",
    "few_light_points",
    "material_findings",
    "nothing_shaded",
    "skipped_steps",
    "surface_findings",
    "verdict_of",
    "worse_than_constant",
]

Verdict = Literal["sound", "doubtful", "failed"]

MIN_OPAQUE = 0.05
"""Minimum share of the object's pixels whose rays are opaque. It is 0 if the scene is empty."""
MIN_SHARP = 0.5
"""Minimum share of the opaque rays that hit a single surface. In fog the weights of a ray are spread out, so
only few rays do.
"""
MAX_WIDTH = 0.025
"""Largest β at which a surface can be sharp, scene units. Above it, rays that meet a ball head-on have less
than 0.8 of their weight near one point, so they are not hits (`shading.hit_share`).
"""
MAX_AT_BOUND = 0.2
"""Maximum share of the surface whose base colour is black or white. Runs with a light of the right scale had
at most 9 %, a dark statue under a light that was 25 times too dim 42 %.
"""
MIN_PARKED = 0.95
"""Share of the surface from which a parameter at its bound says nothing about the object. In eleven runs that
are not wrong at most 24 % had a roughness of 0 or 1, and 17 % a metallic of 1.
"""
MAX_POOR_PSNR = 20.0
"""PSNR in dB, an error of a tenth, from which a rendering is no finding: an object of one colour is nearly a
constant. Eleven runs were 5 to 16 dB better than the best constant, and two of the dark statue 2 and 5 dB.
"""
MAX_OFF_CLOUD = 0.2
"""Largest median distance between the surface and the point cloud that supervises it, in scene units. It was
0.01 to 0.04 in captures of objects, a castle and a table, and 0.5 to 0.6 with a shell in front of the object.
"""
MIN_HELD_BACK = 100
"""Number of held-back pixels below which they are not compared with one colour: a few patches resemble it."""
MAX_EMPTY_STEPS = 50
"""Number of consecutive steps of a material stage without a surface point that is a finding."""
MIN_LIGHT_POINTS = 100
"""Minimum number of surface points for a fit of a light with thousands of texels."""
MAX_SKIPPED = 0.05
"""Maximum share of steps that are skipped because a loss or gradient is not finite."""
MIN_STEPS = 100
"""Number of steps below which the share of skipped steps is not significant."""


@dataclass(frozen=True)
class Finding:
    """Something that is wrong with a run.

    Attributes:
        case: name of the case, as in docs/health.md.
        severe: whether the result is unusable rather than doubtful.
        step: training step at which it was found.
        what: description of the problem.
        cause: the likely cause.
        remedy: what to do.
    """

    case: str
    severe: bool
    step: int
    what: str
    cause: str
    remedy: str

    def line(self) -> str:
        """One line for the console."""
        return f"step {self.step}: {self.what}; likely {self.cause}; {self.remedy}"


@dataclass(frozen=True)
class Case:
    """What all findings of one case have in common; the attributes are those of `Finding`."""

    name: str
    severe: bool
    cause: str
    remedy: str

    def found(self, step: int, what: str) -> Finding:
        """A finding of this case."""
        return Finding(self.name, self.severe, step, what, self.cause, self.remedy)


NO_SURFACE = Case(
    name="no_surface",
    severe=True,
    cause="a scene box that misses the object, or masks that are inverted",
    remedy="check that the object lies in the unit sphere of the scene and that masks are 1 on it "
    "(`neilfpp inspect` draws both for a capture)",
)
FOG = Case(
    name="fog",
    severe=True,
    cause="a scene box that contains the cameras, or too few views, steps or masks",
    remedy="check the scene box (`neilfpp inspect` draws that of a capture), give masks, or train the "
    "geometry for more steps (train.sdf_steps)",
)
BETA_STUCK = Case(
    name="beta_stuck",
    severe=True,
    cause="a width β that is only learned, and photographs that fog explains well enough",
    remedy="bound it (host.volume.beta_final to 0.002), raise its learning rate (optimizer.beta), or start "
    "lower (host.volume.beta_init)",
)
OFF_CLOUD = Case(
    name="off_point_cloud",
    severe=True,
    cause="views that overlap so little that a shell in front of the object explains them as well",
    remedy="raise the weight of the cloud (host.loss.point_cloud to 1) or take more images; if the cloud is "
    "wrong, leave it out (host.loss.point_cloud 0)",
)
NOTHING_SHADED = Case(
    name="nothing_shaded",
    severe=True,
    cause="a distance field that never formed a surface",
    remedy="look at a rendering of the geometry (in a run folder previews/sdf_init.png)",
)
FEW_LIGHT_POINTS = Case(
    name="few_light_points",
    severe=False,
    cause="masks or a surface that leave few pixels to shade",
    remedy="check the masks and a rendering of the geometry, or use more rays per step (train.rays, in your "
    "own loop the size of the batch)",
)
MATERIAL_AT_BOUNDS = Case(
    name="material_at_bounds",
    severe=False,
    cause="a light with a wrong scale",
    remedy="give a known environment map (light.map, in `neilfpp train` --light), or read docs/light.md",
)
ROUGHNESS_AT_BOUND = Case(
    name="roughness_at_bound",
    severe=False,
    cause="too few directions per point for a mirror (0), or images or a light without highlights (1)",
    remedy="for 0 raise shading.train_samples; for 1 give a known light (light.map) or lower loss.lambertian",
)
METALLIC_AT_BOUND = Case(
    name="metallic_at_bound",
    severe=False,
    cause="paint that is taken for metal, unless all of the object is metal",
    remedy="if it is not, switch metals off (brdf.metals False, in `neilfpp train` --effects auto,-metals)",
)
WORSE_THAN_CONSTANT = Case(
    name="worse_than_constant",
    severe=True,
    cause="a light with a wrong scale or from a wrong direction, or a surface that is not that of the object",
    remedy="compare the previews of SDF init and of material; check a given light, or read docs/light.md",
)
SKIPPED_STEPS = Case(
    name="skipped_steps",
    severe=False,
    cause="pixels far above the rest, or learning rates that are too high",
    remedy="look for the brightest pixels (`neilfpp inspect` reports those of a capture), or lower the "
    "learning rates (optimizer)",
)


# ------------------------------------------------------------------------------------------------- conditions


def surface_findings(measured: SurfaceMeasurement, step: int) -> list[Finding]:
    """Find `NO_SURFACE`, `BETA_STUCK`, `FOG` or `OFF_CLOUD`, when a surface should have formed.

    If β alone makes fog of any surface, the finding is `BETA_STUCK`, because the remedies of `FOG` do not
    help.
    """
    if measured.opaque < MIN_OPAQUE:
        what = f"only {measured.opaque:.0%} of the object's pixels show a surface"
        return [NO_SURFACE.found(step, what)]
    if measured.sharp < MIN_SHARP and measured.width is not None and measured.width > MAX_WIDTH:
        what = f"the surface has not become sharp: its width β is still {measured.width:.2g} scene units"
        return [BETA_STUCK.found(step, what)]
    if measured.sharp < MIN_SHARP:
        what = f"only {measured.sharp:.0%} of the rays that show something meet one surface: the scene is fog"
        return [FOG.found(step, what)]
    if measured.off_cloud is not None and measured.off_cloud > MAX_OFF_CLOUD:
        what = f"half of the surface is {measured.off_cloud:.2f} scene units or more from the point cloud"
        return [OFF_CLOUD.found(step, what)]
    return []


def material_findings(measured: SurfaceMeasurement, step: int) -> list[Finding]:
    """Find `MATERIAL_AT_BOUNDS`, `ROUGHNESS_AT_BOUND` and `METALLIC_AT_BOUND`."""
    findings = []
    if measured.at_bound is not None and measured.at_bound > MAX_AT_BOUND:
        what = f"the base colour of {measured.at_bound:.0%} of the surface is black or white"
        case = replace(MATERIAL_AT_BOUNDS, severe=measured.at_bound >= MIN_PARKED)
        findings.append(case.found(step, what))
    for parameter, share in measured.parked.items():
        if share >= MIN_PARKED:
            case = METALLIC_AT_BOUND if parameter.startswith("metallic") else ROUGHNESS_AT_BOUND
            findings.append(case.found(step, f"{share:.0%} of the surface has {parameter}"))
    return findings


def worse_than_constant(held_back: HeldBack, step: int) -> list[Finding]:
    """Find `WORSE_THAN_CONSTANT`, at the end of a stage that trains material."""
    is_fair = held_back.physical is None or held_back.physical >= min(held_back.constant, MAX_POOR_PSNR)
    if is_fair or len(held_back.hits) < MIN_HELD_BACK:
        return []
    what = (
        f"material and light explain held-back pixels ({held_back.physical:.1f} dB) worse than one colour "
        f"for all of them ({held_back.constant:.1f} dB)"
    )
    return [WORSE_THAN_CONSTANT.found(step, what)]


def nothing_shaded(steps: int, step: int) -> list[Finding]:
    """Find `NOTHING_SHADED`, after `steps` consecutive steps without a surface point to shade."""
    if steps < MAX_EMPTY_STEPS:
        return []
    what = f"no surface point was shaded for {steps} steps, so material and light learn nothing"
    return [NOTHING_SHADED.found(step, what)]


def few_light_points(points: int, step: int) -> list[Finding]:
    """Find `FEW_LIGHT_POINTS`, after a fit of the light to `points` points."""
    if points >= MIN_LIGHT_POINTS:
        return []
    what = f"the light was fitted to only {points} surface points, without a decision about lamps"
    return [FEW_LIGHT_POINTS.found(step, what)]


def skipped_steps(skipped: int, step: int) -> list[Finding]:
    """Find `SKIPPED_STEPS`, after `skipped` of the first `step` steps were skipped."""
    if step < MIN_STEPS or skipped <= MAX_SKIPPED * step:
        return []
    what = f"{skipped} of {step} steps were skipped, as they were not finite"
    return [SKIPPED_STEPS.found(step, what)]


# --------------------------------------------------------------------------------------------------- verdicts


def verdict_of(findings: Iterable[Finding]) -> Verdict:
    """The verdict that follows from all findings: that of the worst one."""
    severe = [finding.severe for finding in findings]
    return "failed" if any(severe) else "doubtful" if severe else "sound"


@dataclass(frozen=True)
class Health:
    """A verdict and the findings on which it is based.

    Attributes:
        verdict: the verdict.
        findings: one finding per case; empty if the verdict is "sound".
    """

    verdict: Verdict
    findings: tuple[Finding, ...]

    @staticmethod
    def of(findings: Iterable[Finding]) -> Health:
        """The health that follows from findings."""
        all_findings = tuple(findings)
        return Health(verdict_of(all_findings), all_findings)

    @property
    def failure(self) -> Finding | None:
        """The first finding that makes the result unusable; None if there is none."""
        return next((finding for finding in self.findings if finding.severe), None)

    def __str__(self) -> str:
        return self.verdict + (": " + "; ".join(f.what for f in self.findings) if self.findings else "")
