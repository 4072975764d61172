"""Collect evidence and record decisions at the moments of training when a measurement is cheap.

These are before training, before material init, before the joint stage, and after each fit of the light.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import torch

from neilfpp_method.data.pixels.dataset import PixelDataset
from neilfpp_method.effects.evidence.alternatives import Alternatives
from neilfpp_method.effects.evidence.diffuse import diffuse_evidence
from neilfpp_method.effects.evidence.disagreement import RenderedSurface, shading_disagreement
from neilfpp_method.effects.evidence.exposure import Exposures
from neilfpp_method.effects.evidence.lobes import lobe_evidence
from neilfpp_method.effects.evidence.material import EFFECTS_AT_PLACES, material_evidence
from neilfpp_method.effects.evidence.metals import find_metal, metals_evidence, metals_evidence_in
from neilfpp_method.effects.evidence.poses import pose_evidence
from neilfpp_method.effects.evidence.visibility import self_visibility
from neilfpp_method.effects.first_light import MIN_PLACES, FirstLight, find_first_light
from neilfpp_method.effects.measurement import Measurement
from neilfpp_method.effects.places.gathering import Places, gather_places
from neilfpp_method.effects.places.lit import LitPlaces, light_up
from neilfpp_method.effects.places.rescaling import correct_scale
from neilfpp_method.effects.places.search import Comparison, search_materials, teach
from neilfpp_method.effects.plan import Decision, Plan
from neilfpp_method.lighting.fit import MIN_GAIN, Evidence
from neilfpp_method.lighting.solver import LightSolver
from neilfpp_method.model import NeilfModel
from neilfpp_method.schedule import has_material
from neilfpp_method.settings.facts import SceneFacts
from neilfpp_method.structures import Observed, PixelBatch

__all__ = [
    "MAX_PIXELS",
    "MIN_PIXELS",
    "MIN_TRAIN_VIEWS",
    "POSE_STEPS",
    "SURFACE_PIXELS",
    "Improved",
    "LightReview",
    "improve_material",
    "light_places",
    "needs_surface",
    "record_exposures",
    "record_facts",
    "record_lamps",
    "review_diffuse",
    "review_light",
    "review_light_at",
    "review_material",
    "review_metals",
    "review_poses",
    "review_surface",
    "review_visibility",
]

SURFACE_PIXELS = 1024
"""Number of training pixels whose surface points are measured. The standard error of a share of 1 % is then
0.3 %.
"""
MIN_TRAIN_VIEWS = 8
"""Minimum number of training views for an initial light: fewer do not determine its scale."""
LIGHT_PIXELS = 4096
"""Number of training pixels whose surface points are candidates for places."""
PLACES = 1200
"""Maximum number of places for the initial light."""
VIEWS = 20
"""Maximum number of views per place. 10,000 pixels take 200 MB."""
POSE_STEPS = 200
"""Minimum number of steps after which poses are judged. After 24 steps of the short demo, corrections of
exact poses reduced the error of R by 1.5 to 3 %, almost as much as those of inaccurate poses do later.
"""
MIN_VIEWS = 4
"""Minimum number of views per place: fewer do not distinguish materials."""
RAYS_AT_ONCE = 512
"""Maximum number of rays that are rendered at once; it bounds memory."""
USUAL_VIEWS = 8
"""Number of views per place that is assumed when a number of pixels is converted to a number of places."""
MIN_PIXELS = MIN_PLACES * USUAL_VIEWS
"""Minimum number of pixels for an initial light."""
MAX_PIXELS = PLACES * VIEWS
"""Maximum number of pixels of the places for the initial light."""


def record_facts(plan: Plan, facts: SceneFacts) -> None:
    """Record the decisions that follow from the files of the capture, before training."""
    if plan.newest("background") is None:
        on = facts.background == "inverted_sphere"
        reason = f"the borders of the images show {'more than one colour' if on else 'a single colour'}"
        plan.decisions.append(Decision(0, "background", on, "files", reason))
    response = plan.newest("response")
    if response is None or response.by != "files":
        on = facts.response == "srgb"
        kind = "display values" if on else "linear radiance"
        plan.decisions.append(Decision(0, "response", on, "files", f"the files hold {kind}"))


def record_exposures(plan: Plan, exposures: Exposures | None) -> None:
    """Record the decision on gains of the photographs, before training.

    Args:
        plan: the plan to which the decision is added, unless it has one already.
        exposures: the measured exposures; None if the capture has no point cloud.
    """
    if plan.newest("exposure") is not None:
        return
    if exposures is None:
        reason = "not measured: this needs a point cloud"
        plan.decisions.append(Decision(0, "exposure", False, "files", reason))
        return
    on, reason = exposures.measured.favours(chosen=False) is True, exposures.measured.summary()
    plan.decisions.append(Decision(0, "exposure", on, "files", reason, exposures.measured))


def needs_surface(plan: Plan) -> bool:
    """Whether `review_surface` or `review_material` could decide anything."""
    return any(plan.is_open(name) for name in ("inter-reflection", *EFFECTS_AT_PLACES, "joint-stage"))


@dataclass(frozen=True)
class LightReview:
    """The result of `review_light`.

    Attributes:
        decisions: the new decisions.
        first: the initial light; None if there are too few views or places, or if surfaces have no specular
            lobe.
    """

    decisions: list[Decision]
    first: FirstLight | None


@torch.no_grad()
def review_light(
    plan: Plan, model: NeilfModel, pixels: PixelDataset, step: int, max_pixels: int = MAX_PIXELS
) -> LightReview:
    """Decide on the specular lobe and on metals if these are open, and find an initial light.

    The model uses the settings of the plan afterwards. The arguments are those of `review_surface`, and
    `max_pixels`, the maximum number of pixels of the places; below `MIN_PIXELS` nothing is measured.
    """
    if len(pixels.views) < MIN_TRAIN_VIEWS:
        return _without_light(plan, step, f"fewer than {MIN_TRAIN_VIEWS} training views")
    if max_pixels < MIN_PIXELS:
        return _without_light(plan, step, "the budget leaves no time for it")
    with model.evaluating():
        return review_light_at(light_places(model, pixels, max_pixels), plan, model, step)


def review_light_at(places: Places, plan: Plan, model: NeilfModel, step: int) -> LightReview:
    """`review_light` at given places, with the model in evaluation mode."""
    if places.shown_count < MIN_PLACES:
        return _without_light(plan, step, f"fewer than {MIN_PLACES} places are shown by {MIN_VIEWS} views")
    alternatives, decisions, first = Alternatives(places, model.scene, model.facts), [], None
    if plan.is_open("long-tails") and plan.newest("long-tails") is None:
        measured = lobe_evidence(alternatives, model.brdf.metals)
        decisions.append(plan.decide("long-tails", measured, step))
        model.use(plan.config)
    if model.lobe is not None:
        lobe = model.config.shading.lobe
        if plan.is_open("metals") and model.brdf.metals:
            measured = metals_evidence(alternatives, lobe)
            decisions.append(plan.decide("metals", measured, step))
            model.use(plan.config)
        first = find_first_light(alternatives.data(lobe), model.brdf.metals)
    return LightReview(decisions, first)


@torch.no_grad()
def light_places(model: NeilfModel, pixels: PixelDataset, max_pixels: int = MAX_PIXELS) -> Places:
    """Places on the visible surface that several training views show, with at most `max_pixels` pixels."""
    with model.evaluating():
        surface = _rendered_surface(model, pixels.sample(LIGHT_PIXELS, gradients=False)).observed
        count = min(PLACES, max_pixels // USUAL_VIEWS)
        position, normal = surface.position[:count], surface.normal[:count]
        places = gather_places(model, pixels, position, normal, VIEWS)
        return places.with_at_least(MIN_VIEWS).first(max_pixels)


@dataclass(frozen=True)
class Improved:
    """The result of `improve_material`.

    Attributes:
        lit: the places under the light afterwards.
        summaries: lines for the console.
    """

    lit: LitPlaces
    summaries: list[str]


def improve_material(
    model: NeilfModel, solver: LightSolver, places: Places, comparison: Comparison
) -> Improved | None:
    """Correct the scale of a half-trained model, and its material where training is stuck (`places.search`).

    Args:
        model: its light is an environment map; see `places.search.comparison_due`.
        solver: keeps the scale in later fits of the light.
        places: places in the training views, with linear radiance.
        comparison: what is compared.

    Returns:
        None if there are fewer than `MIN_PLACES` places.
    """
    if places.shown_count < MIN_PLACES:
        return None
    lit, summaries = light_up(model, places), []
    rescaled = correct_scale(model, solver, lit)
    if rescaled is not None:
        lit = lit.dimmed(rescaled.factor)
        summaries.append(rescaled.summary())
    if comparison is Comparison.MATERIAL and (model.brdf.metals or model.brdf.varying_roughness):
        searched = search_materials(model.brdf, lit)
        if searched.share > 0:
            teach(model.brdf, searched)
        summaries.append(f"material search: training is stuck at {searched.share:.0%} of the places")
    return Improved(lit, summaries)


def review_metals(plan: Plan, model: NeilfModel, lit: LitPlaces, step: int) -> list[Decision]:
    """Decide again on metals that are off, under the light of a half-trained model.

    If they are on afterwards, the model uses them, and its BRDF field is trained on the metal that was found.

    Args:
        plan: the plan to which the decision is added.
        model: its light is an environment map; see `places.search.comparison_due`.
        lit: places under this light.
        step: number of steps trained so far.

    Returns:
        The new decision; empty if metals are on or decided otherwise.
    """
    if model.brdf.metals or not plan.is_open("metals"):
        return []
    response = model.facts.response
    decision = plan.decide("metals", metals_evidence_in(lit, response), step)
    if decision.on:
        model.use(plan.config)
        teach(model.brdf, find_metal(lit, model.brdf, response))
    return [decision]


@torch.no_grad()
def review_diffuse(plan: Plan, model: NeilfModel, lit: LitPlaces, step: int) -> list[Decision]:
    """Decide whether diffuse reflection depends on the roughness, under the light of a half-trained model.

    The model uses the settings of the plan afterwards.

    Args:
        plan: the plan to which the decision is added.
        model: its light is an environment map; see `places.search.comparison_due`.
        lit: places under this light, with the lobe of the model.
        step: number of steps trained so far.

    Returns:
        The new decision; empty if it is on, was decided otherwise, or if highlights have no long tails.
    """
    if model.config.shading.lobe != "ggx" or not plan.is_open("rough-diffuse"):
        return []
    decision = plan.decide("rough-diffuse", diffuse_evidence(model, lit), step)
    model.use(plan.config)
    return [decision]


def review_poses(plan: Plan, model: NeilfModel, pixels: PixelDataset, step: int) -> list[Decision]:
    """Decide once whether poses are corrected, if this is open. The arguments are those of `review_surface`.

    Args:
        pixels: the training pixels with poses as given.
    """
    if not plan.is_open("poses") or plan.newest("poses") is not None:
        return []
    if step < POSE_STEPS:
        decisions = _not_measured(
            plan, step, {"poses": False}, f"R is blurred after fewer than {POSE_STEPS} steps"
        )
    else:
        decisions = [plan.decide("poses", pose_evidence(model, pixels), step)]
    model.use(plan.config)
    return decisions


def review_visibility(plan: Plan, model: NeilfModel, surface: Observed, step: int) -> list[Decision]:
    """Decide on shadows and inter-reflection at surface points, if this is open."""
    if not plan.is_open("inter-reflection"):
        return []
    measured = self_visibility(model, plan.settings, surface.position, surface.normal)
    return [plan.decide("inter-reflection", measured, step)]


@torch.no_grad()
def review_surface(plan: Plan, model: NeilfModel, pixels: PixelDataset, step: int) -> list[Decision]:
    """Take the decisions that depend on the surface: before material init, and before the joint stage.

    Args:
        plan: the plan to which the decisions are added.
        model: the model after `step` steps; its training mode is left unchanged.
        pixels: the training pixels.
        step: number of steps trained so far.

    Returns:
        The new decisions.
    """
    decisions = []
    with model.evaluating():
        rendered = _rendered_surface(model, pixels.sample(SURFACE_PIXELS, gradients=False))
        surface = rendered.observed
        decisions += review_visibility(plan, model, surface, step)
        if plan.is_open("joint-stage") and has_material(step, plan.settings.train):
            decisions.append(plan.decide("joint-stage", shading_disagreement(model, rendered), step))
    return decisions


@torch.no_grad()
def review_material(plan: Plan, model: NeilfModel, pixels: PixelDataset, step: int) -> list[Decision]:
    """Take the decisions that compare fits of light and material at places, after those on lobe and metals.

    The arguments and the result are those of `review_surface`.
    """
    names = frozenset(name for name in EFFECTS_AT_PLACES if plan.is_open(name))
    if not names:
        return []
    with model.evaluating():
        surface = _rendered_surface(model, pixels.sample(SURFACE_PIXELS, gradients=False)).observed
        evidence = material_evidence(model, pixels, surface.position, surface.normal, names)
    return [plan.decide(name, measured, step) for name, measured in evidence.items()]


def record_lamps(plan: Plan, evidence: Evidence | None, count: int, step: int) -> list[Decision]:
    """Record the decision on lamps that the light solver has taken in a fit.

    Args:
        plan: the plan to which the decision is added.
        evidence: the comparison of the fits with and without lamps; None if there was none.
        count: number of lamps after the fit.
        step: number of steps trained so far.

    Returns:
        The new decision; empty if it is the same as before.
    """
    if evidence is None or not plan.is_open("lamps"):
        return []
    before, on = plan.newest("lamps"), count > 0
    if before is not None and before.on == on:
        return []
    where, threshold = ("in held-back views", 0.0) if evidence.in_views else ("at held-back points", MIN_GAIN)
    what = f"reduction of the error {where} by lamps"
    measured = Measurement(what, evidence.gain, evidence.deviation, threshold, evidence.points)
    reason = measured.summary() if before is None else f"revised: {measured.summary()}"
    plan.decisions.append(Decision(step, "lamps", on, "evidence", reason, measured))
    return plan.decisions[-1:]


def _without_light(plan: Plan, step: int, reason: str) -> LightReview:
    """Record that the lobe and metals stay as they are, if they are open."""
    unchanged = {name: plan.is_on(name) for name in ("long-tails", "metals") if plan.is_open(name)}
    return LightReview(_not_measured(plan, step, unchanged, reason), None)


def _not_measured(plan: Plan, step: int, effects: Mapping[str, bool], reason: str) -> list[Decision]:
    """Record for open effects whether they are on, and why there is no evidence."""
    decisions = [
        Decision(step, name, on, "evidence", f"not measured: {reason}") for name, on in effects.items()
    ]
    plan.decisions += decisions
    return decisions


def _rendered_surface(model: NeilfModel, pixels: PixelBatch) -> RenderedSurface:
    """Render pixels and keep those whose ray hits the object."""
    pixels = pixels[torch.nonzero(pixels.mask > 0.5)[:, 0]]
    parts = []
    for start in range(0, len(pixels), RAYS_AT_ONCE):
        part = pixels[start : start + RAYS_AT_ONCE]
        hits = model.host.render(part.rays)
        rows = torch.nonzero(hits.is_hit(model.config.shading.hit_share))[:, 0]
        hits, part = hits[rows], part[rows]
        normal = model.shading_normals(hits.position, hits.normal)
        observed = Observed(hits.position, normal, -part.directions, part.color)
        parts.append(RenderedSurface(observed, hits.color))
    if not parts:
        return RenderedSurface(Observed(*[pixels.color[:0]] * 4), pixels.color[:0])
    return RenderedSurface(
        Observed.joined([part.observed for part in parts]), torch.cat([part.radiance for part in parts])
    )
