"""Decide on effects by evidence, and set light and material, between the steps of a training.

All training loops call these functions after the same steps. Their random numbers depend only on the seed and
the number of the step, so all loops decide alike.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

from neilfpp_method.data.pixels.dataset import PixelDataset
from neilfpp_method.effects.first_light import MIN_PLACES
from neilfpp_method.effects.following import Followers, follow, improve, start_light
from neilfpp_method.effects.places import rescaling
from neilfpp_method.effects.places.lit import light_up
from neilfpp_method.effects.places.search import comparison_due, is_comparable
from neilfpp_method.effects.plan import Decision, Plan
from neilfpp_method.effects.review import (
    MAX_PIXELS,
    MIN_PIXELS,
    light_places,
    needs_surface,
    review_light,
    review_material,
    review_surface,
)
from neilfpp_method.lighting.fit import Evidence
from neilfpp_method.model import NeilfModel
from neilfpp_method.schedule import StagePosition
from neilfpp_method.train.optimizer import Stream, seed_stream

__all__ = [
    "Subject",
    "correct_final_scale",
    "improve_half_trained",
    "is_improvement_due",
    "review_before_material",
]

Review = Callable[[Plan, NeilfModel, PixelDataset, int], list[Decision]]
"""Measures with the model after so many steps and adds its decisions to the plan."""


@dataclass(frozen=True)
class Subject(Followers):
    """What is measured, besides what follows the decisions.

    Attributes:
        pixels: the training pixels, on the device of the model.
        seed: seed of the training.
        max_pixels: maximum number of pixels of the places for the initial light; a budget may limit it.
    """

    pixels: PixelDataset
    seed: int
    max_pixels: int = MAX_PIXELS


def review_before_material(subject: Subject, step: int) -> Evidence | None:
    """Take the measurements before a stage that trains material, and set the initial light.

    Args:
        subject: what is measured.
        step: number of steps trained so far.

    Returns:
        The evidence for lamps in the initial light; None if no light was set or the settings decide.
    """
    _review(subject, step, review_surface, Stream.SURFACE)
    evidence = _start_light(subject, step)
    _review(subject, step, review_material, Stream.MATERIAL)
    return evidence


def is_improvement_due(subject: Subject, position: StagePosition) -> bool:
    """Whether `improve_half_trained` is due after `position.step` steps of a stage."""
    return subject.max_pixels >= MIN_PIXELS and comparison_due(subject.model, position) is not None


def improve_half_trained(subject: Subject, position: StagePosition, step: int) -> None:
    """Correct the scale of light and material, and review metals and the diffuse lobe (`effects.review`).

    This may change the light and train the BRDF field.

    Args:
        subject: what is measured.
        position: the stage, and the number of steps trained in it.
        step: number of steps trained so far in all stages.
    """
    model, solver = subject.model, subject.light_solver
    comparison = comparison_due(model, position)
    if comparison is None:
        return
    is_reviewed = any(subject.plan.is_open(name) for name in ("metals", "rough-diffuse"))
    if not (model.brdf.metals or is_reviewed or solver.scale_is_free):
        return
    seed_stream(subject.seed, Stream.SEARCH, step)
    places = light_places(model, subject.pixels, subject.max_pixels)
    improve(subject, places, comparison, step)


def correct_final_scale(subject: Subject, step: int) -> None:
    """Correct the scale of light and base colour after the last step, when the light is most exact.

    Args:
        subject: what is measured; its light and its BRDF field may change.
        step: number of steps trained in all stages.
    """
    model, solver = subject.model, subject.light_solver
    if subject.max_pixels < MIN_PIXELS or not is_comparable(model) or not solver.scale_is_free:
        return
    seed_stream(subject.seed, Stream.SEARCH, step)
    places = light_places(model, subject.pixels, subject.max_pixels)
    if places.shown_count < MIN_PLACES:
        return
    rescaled = rescaling.correct_final_scale(model, solver, light_up(model, places))
    if rescaled is not None:
        subject.say(rescaled.summary())


def _review(subject: Subject, step: int, review: Review, stream: Stream) -> None:
    """Decide open effects by evidence, with the random numbers of a stream."""
    if needs_surface(subject.plan):
        seed_stream(subject.seed, stream, step)
        follow(subject, review(subject.plan, subject.model, subject.pixels, step))


def _start_light(subject: Subject, step: int) -> Evidence | None:
    """Set the initial light, after the decisions on lobe and metals. Returns the evidence for lamps."""
    if not subject.light_solver.seeks_start:
        return None
    subject.say("fitting light and material at selected places, to decide on effects …")
    seed_stream(subject.seed, Stream.LIGHT, step)
    review = review_light(subject.plan, subject.model, subject.pixels, step, subject.max_pixels)
    return start_light(subject, review, step)
