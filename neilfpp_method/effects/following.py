"""What follows the decisions on effects in every kind of training loop: the console, the model, its light."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

from neilfpp_method.effects.places.gathering import Places
from neilfpp_method.effects.places.search import Comparison
from neilfpp_method.effects.plan import Decision, Plan
from neilfpp_method.effects.review import (
    LightReview,
    improve_material,
    record_lamps,
    review_diffuse,
    review_metals,
)
from neilfpp_method.effects.start import start_with
from neilfpp_method.lighting.fit import Evidence
from neilfpp_method.lighting.solver import LightSolver
from neilfpp_method.model import NeilfModel

__all__ = ["Followers", "follow", "follow_fit", "improve", "start_light"]


@dataclass(frozen=True)
class Followers:
    """What follows the decisions on effects.

    Attributes:
        plan: the effects; decisions are added to it.
        model: the model in training, which uses the settings of the plan.
        light_solver: fits the light of this model.
        say: prints a line.
    """

    plan: Plan
    model: NeilfModel
    light_solver: LightSolver
    say: Callable[[str], object]


def follow(followers: Followers, decisions: Sequence[Decision]) -> None:
    """Print decisions, and use the settings that follow from the plan."""
    for decision in decisions:
        followers.say(decision.summary())
    if decisions:
        config = followers.plan.config
        followers.model.use(config)
        followers.light_solver.use(config.light, followers.model.lobe)


def follow_fit(followers: Followers, evidence: Evidence | None, step: int) -> None:
    """Record what a fit of the light after `step` steps has decided on lamps."""
    count = followers.model.lamps.count
    follow(followers, record_lamps(followers.plan, evidence, count, step))


def start_light(followers: Followers, review: LightReview, step: int) -> Evidence | None:
    """Follow the decisions on lobe and metals, and set the initial light.

    Args:
        followers: what follows.
        review: the decisions, and the initial light if there is one.
        step: number of steps trained so far.

    Returns:
        The evidence for lamps in the initial light; None if no light was set or the settings decide.
    """
    follow(followers, review.decisions)
    if review.first is None:
        return None
    followers.say(review.first.summary())
    evidence = start_with(followers.model, followers.light_solver, review.first)
    follow_fit(followers, evidence, step)
    return evidence


def improve(followers: Followers, places: Places, comparison: Comparison, step: int) -> None:
    """Correct the scale of a half-trained model, and review metals and the diffuse lobe (`review`).

    Args:
        followers: what follows; the light may change, and the BRDF field may be trained.
        places: places in the training views, with linear radiance.
        comparison: what is compared; effects are reviewed together with material.
        step: number of steps trained so far.
    """
    improved = improve_material(followers.model, followers.light_solver, places, comparison)
    if improved is None:
        return
    for summary in improved.summaries:
        followers.say(summary)
    if comparison is Comparison.MATERIAL:
        plan, model = followers.plan, followers.model
        follow(followers, review_metals(plan, model, improved.lit, step))
        follow(followers, review_diffuse(plan, model, improved.lit, step))
