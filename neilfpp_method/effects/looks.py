"""When evidence is measured: before and after a material stage, and after each fit of the light."""

from __future__ import annotations

import torch

from neilfpp_method.data.pixels import PixelDataset
from neilfpp_method.effects.disagreement import ShownSurface, shading_disagreement
from neilfpp_method.effects.exposure import Exposures
from neilfpp_method.effects.first_light import MIN_PLACES, FirstLight, find_first_light
from neilfpp_method.effects.lobes import lobe_evidence
from neilfpp_method.effects.material import JUDGED, material_evidence
from neilfpp_method.effects.measurement import Measurement
from neilfpp_method.effects.places import gather_places
from neilfpp_method.effects.plan import Decision, Plan
from neilfpp_method.effects.visibility import self_visibility
from neilfpp_method.lighting.fit import MIN_GAIN, Evidence
from neilfpp_method.model import NeilfModel
from neilfpp_method.schedule import has_material
from neilfpp_method.settings.facts import SceneFacts
from neilfpp_method.structures import Observed, PixelBatch

__all__ = [
    "FEWEST_PIXELS",
    "LOOKED_AT",
    "MIN_PHOTOGRAPHS",
    "MOST_PIXELS",
    "after_fit",
    "look_at_light",
    "look_at_surface",
    "note_exposures",
    "note_facts",
    "wants_surface",
]

LOOKED_AT = 1024
"""Training pixels whose surface points are measured: the standard error of a 1 % share is 0.3 %."""
MIN_PHOTOGRAPHS = 8
"""Training views from which a light is found to start with: fewer tell too little of its scale."""
LIGHT_PIXELS = 4096
"""Training pixels among which places are looked for that many views show."""
PLACES, VIEWS, MIN_VIEWS = 1200, 20, 4
"""How many places the light starts from at most, and how many views of each; fewer views than these do not
tell materials apart. 10,000 pixels take 200 MB.
"""
USUAL_VIEWS = 8
"""Views that show a place in a capture from all around it: of so many pixels a place is made."""
AT_ONCE = 512
"""Rays that are rendered together; bounds the memory."""
FEWEST_PIXELS = MIN_PLACES * USUAL_VIEWS
"""Pixels without which the first light is not looked for."""
MOST_PIXELS = PLACES * VIEWS
"""Pixels that the places of the first light have at most."""


def note_facts(plan: Plan, facts: SceneFacts) -> None:
    """What the files of the capture decide before training."""
    if plan.newest("background") is None:
        on = facts.background == "inverted_sphere"
        seen = (
            "the borders of the images show more than one colour"
            if on
            else "one colour is all that the borders show"
        )
        plan.decisions.append(Decision(0, "background", on, "files", seen))
    response = plan.newest("response")
    if response is None or response.by != "files":
        on = facts.response == "srgb"
        kind = "display values" if on else "linear radiance"
        plan.decisions.append(Decision(0, "response", on, "files", f"the files hold {kind}"))


def note_exposures(plan: Plan, found: Exposures | None) -> None:
    """What the photographs say of their exposures before training; none where nothing shows them the same
    places.
    """
    if plan.newest("exposure") is not None:
        return
    if found is None:
        unknown = "without a point cloud nothing tells the same place in two photographs"
        plan.decisions.append(Decision(0, "exposure", False, "files", unknown))
        return
    on, reason = found.measured.favours(chosen=False) is True, found.measured.in_words()
    plan.decisions.append(Decision(0, "exposure", on, "files", reason, found.measured))


def wants_surface(plan: Plan) -> bool:
    """Whether a look at the surface could decide anything."""
    return any(plan.is_open(name) for name in ("inter-reflection", *JUDGED, "joint-stage"))


@torch.no_grad()
def look_at_light(
    plan: Plan, model: NeilfModel, pixels: PixelDataset, step: int, most: int = MOST_PIXELS
) -> tuple[list[Decision], FirstLight | None]:
    """Decide on the lobe of highlights where that is open, and find the light that training starts with.

    Arguments as of `look_at_surface`, and `most`: pixels that the places have at most; with too few for
    `MIN_PLACES` nothing is looked for. The model computes as the plan says afterwards.
    """
    if len(pixels.views) < MIN_PHOTOGRAPHS or most < FEWEST_PIXELS:
        return [], None
    mode = model.training
    model.eval()
    surface = _shown_surface(model, pixels.sample(LIGHT_PIXELS, gradients=False)).observed
    count = min(PLACES, most // USUAL_VIEWS)
    position, normal = surface.position[:count], surface.normal[:count]
    places = gather_places(model, pixels, position, normal, VIEWS).in_views(MIN_VIEWS).first(most)
    typical, decisions = model.facts.median_radiance, []
    if len(places.place.unique()) < MIN_PLACES:
        model.train(mode)
        return [], None
    if plan.is_open("long-tails") and plan.newest("long-tails") is None:
        measured = lobe_evidence(places, model.scene, typical, model.brdf.metals)
        decisions.append(plan.decide("long-tails", measured, step, must_be_earned=True))
        model.use(plan.config)
    found = None
    if model.lobe is not None:
        found = find_first_light(places, model.lobe, model.scene, typical, model.brdf.metals)
    model.train(mode)
    return decisions, found


@torch.no_grad()
def look_at_surface(plan: Plan, model: NeilfModel, pixels: PixelDataset, step: int) -> list[Decision]:
    """Decide what a surface tells, before a material is learned on it and again when it has moved.

    Args:
        plan: takes the decisions.
        model: as it is after `step` steps; it stays in the mode that it is in.
        pixels: of the training views.
        step: how many steps have been trained.
    """
    mode = model.training
    model.eval()
    seen = _shown_surface(model, pixels.sample(LOOKED_AT, gradients=False))
    surface = seen.observed
    decisions = []
    if plan.is_open("inter-reflection"):
        measured = self_visibility(model, plan.settings.inter_reflection, surface.position, surface.normal)
        decisions.append(plan.decide("inter-reflection", measured, step))
    names = frozenset(name for name in JUDGED if plan.is_open(name))
    found = material_evidence(model, pixels, surface.position, surface.normal, names) if names else {}
    decisions += [plan.decide(name, measured, step) for name, measured in found.items()]
    if plan.is_open("joint-stage") and has_material(step, plan.settings.train):
        decisions.append(plan.decide("joint-stage", shading_disagreement(model, seen), step))
    model.train(mode)
    return decisions


def after_fit(plan: Plan, found: Evidence | None, lit: int, step: int) -> list[Decision]:
    """What a fit of the light with and without lamps found: the solver chooses, the plan records it.

    Nothing is noted where the choice is what it was.
    """
    if found is None or not plan.is_open("lamps"):
        return []
    before, on = plan.newest("lamps"), lit > 0
    if before is not None and before.on == on:
        return []
    measured = Measurement(
        "error that lamps save at points kept back", found.gain, found.deviation, MIN_GAIN, found.points
    )
    reason = measured.in_words() if before is None else f"revised: {measured.in_words()}"
    plan.decisions.append(Decision(step, "lamps", on, "evidence", reason, measured))
    return plan.decisions[-1:]


def _shown_surface(model: NeilfModel, pixels: PixelBatch) -> ShownSurface:
    pixels = pixels[torch.nonzero(pixels.mask > 0.5)[:, 0]]
    parts = []
    for start in range(0, len(pixels), AT_ONCE):
        part = pixels[start : start + AT_ONCE]
        hits = model.host.render(part.rays)
        rows = torch.nonzero(hits.is_hit(model.config.shading.hit_share))[:, 0]
        hits, part = hits[rows], part[rows]
        normal = model.shading_normals(hits.position, hits.normal)
        parts.append((hits.position, normal, -part.directions, part.color, hits.color))
    joined = [torch.cat(column) for column in zip(*parts, strict=True)] or [pixels.color[:0]] * 5
    return ShownSurface(Observed(*joined[:4]), joined[4])
