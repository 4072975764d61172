"""When evidence is measured: before and after a material stage, and after each fit of the light."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from jaxtyping import Float
from torch import Tensor

from neilfpp_method.data.pixels import PixelDataset
from neilfpp_method.effects.first_light import FirstLight, find_first_light
from neilfpp_method.effects.lobes import lobe_evidence
from neilfpp_method.effects.measurement import Measurement
from neilfpp_method.effects.metals import metal_evidence
from neilfpp_method.effects.places import gather_places
from neilfpp_method.effects.plan import Decision, Plan
from neilfpp_method.effects.visibility import self_visibility
from neilfpp_method.lighting.fit import MIN_GAIN, Evidence
from neilfpp_method.model import NeilfModel
from neilfpp_method.settings.facts import SceneFacts
from neilfpp_method.structures import PixelBatch

__all__ = ["LOOKED_AT", "after_fit", "look_at_light", "look_at_surface", "note_facts", "wants_surface"]

LOOKED_AT = 1024
"""Training pixels whose surface points are measured: the standard error of a 1 % share is 0.3 %."""
LIGHT_PIXELS = 4096
"""Training pixels among which places are looked for that many views show."""
PLACES, VIEWS, MIN_VIEWS = 1200, 20, 4
"""How many places the light starts from at most, and how many views of each; fewer views than these do not
tell materials apart. 10,000 pixels take 200 MB.
"""
AT_ONCE = 512
"""Rays that are rendered together; bounds the memory."""


@dataclass(frozen=True)
class SurfacePoints:
    """Where pixels of the object meet one surface, scene frame."""

    position: Float[Tensor, "P 3"]
    normal: Float[Tensor, "P 3"]


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


def wants_surface(plan: Plan) -> bool:
    """Whether a look at the surface could decide anything."""
    return plan.is_open("inter-reflection") or plan.is_open("metals")


@torch.no_grad()
def look_at_light(
    plan: Plan, model: NeilfModel, pixels: PixelDataset, step: int
) -> tuple[list[Decision], FirstLight | None]:
    """Decide on the lobe of highlights where that is open, and find the light that training starts with.

    Arguments as of `look_at_surface`; the model computes as the plan says afterwards.
    """
    mode = model.training
    model.eval()
    surface = _surface_points(model, pixels.sample(LIGHT_PIXELS, gradients=False))
    position, normal = surface.position[:PLACES], surface.normal[:PLACES]
    places = gather_places(model, pixels, position, normal, VIEWS).in_views(MIN_VIEWS)
    typical, decisions = model.facts.median_radiance, []
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
    surface = _surface_points(model, pixels.sample(LOOKED_AT, gradients=False))
    decisions = []
    if plan.is_open("inter-reflection"):
        measured = self_visibility(model, plan.settings.inter_reflection, surface.position, surface.normal)
        decisions.append(plan.decide("inter-reflection", measured, step))
    if plan.is_open("metals") and plan.newest("metals") is None:
        decisions.append(
            plan.decide("metals", metal_evidence(model, pixels, surface.position, surface.normal), step)
        )
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


def _surface_points(model: NeilfModel, pixels: PixelBatch) -> SurfacePoints:
    pixels = pixels[torch.nonzero(pixels.mask > 0.5)[:, 0]]
    places, normals = [pixels.origins[:0]], [pixels.origins[:0]]
    for start in range(0, len(pixels), AT_ONCE):
        hits = model.host.render(pixels[start : start + AT_ONCE].rays)
        hits = hits[torch.nonzero(hits.is_hit(model.config.shading.hit_share))[:, 0]]
        places.append(hits.position)
        normals.append(model.shading_normals(hits.position, hits.normal))
    return SurfacePoints(torch.cat(places), torch.cat(normals))
