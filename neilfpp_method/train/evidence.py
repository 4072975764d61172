"""The part of the loop that measures: effects and the initial light before a stage, fits of the light in it.

The first process measures and decides for all.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Sequence

from neilfpp_method.data.pixels.dataset import PixelDataset
from neilfpp_method.effects.evidence.poses import next_motion
from neilfpp_method.effects.first_light import start_with
from neilfpp_method.effects.places.gathering import Places
from neilfpp_method.effects.places.search import is_comparison_due, is_search_due
from neilfpp_method.effects.plan import Decision, Plan
from neilfpp_method.effects.review import (
    MAX_PIXELS,
    MIN_PIXELS,
    improve_material,
    light_places,
    needs_surface,
    record_lamps,
    review_light,
    review_material,
    review_metals,
    review_poses,
    review_surface,
)
from neilfpp_method.model import NeilfModel
from neilfpp_method.schedule import StagePosition, stage_at
from neilfpp_method.structures import StepResult
from neilfpp_method.timing.ledger import timed
from neilfpp_method.train.light_record import note_fit
from neilfpp_method.train.optimizer import Stream, seed_stream
from neilfpp_method.train.poses import camera_centers, corrected, is_fit_due
from neilfpp_method.train.training import Training

__all__ = [
    "apply_plan",
    "apply_poses",
    "fit_poses",
    "improve_half_trained",
    "observe_and_solve",
    "review_before_stage",
]

Review = Callable[[Plan, NeilfModel, PixelDataset, int], list[Decision]]
"""Measures with the model after so many steps and adds its decisions to the plan."""


def observe_and_solve(run: Training, computed: StepResult, step: int) -> None:
    """Pass a step to the light solver, which fits the light when that is due.

    The first process does this for all.

    Args:
        run: the training.
        computed: the result of the step.
        step: index of the step in all stages.
    """
    fabric, solver = run.fabric, run.light_solver
    if fabric.is_global_zero:
        with timed("light_fits"):
            solver.observe(computed)
    if not fabric.broadcast(solver.due):
        return
    if fabric.is_global_zero:
        run.watch.after_fit(solver.points, step)
        with timed("light_fits", undivided=True):
            evidence = solver.solve(run.model.brdf, run.model.scene)
        lamps = run.model.lamps.count
        note_fit(run.fits, evidence, lamps, step + 1)
        _report(run, record_lamps(run.plan, evidence, lamps, step + 1))
    _share_light(run)


def _share_light(run: Training) -> None:
    """Copy the light of the first process to all others."""
    if run.fabric.world_size > 1:
        for part in (run.model.light, run.model.lamps):
            part.load_state_dict(run.fabric.broadcast(part.state_dict()))


def review_before_stage(run: Training, step: int) -> None:
    """Take the measurements before a stage that trains material."""
    if run.model.stages[stage_at(step, run.config.train).stage].trains_material:
        _review_effects(run, step, review_surface, Stream.SURFACE)
        _start_light(run, step)
        _review_effects(run, step, review_material, Stream.MATERIAL)


def _start_light(run: Training, step: int) -> None:
    """Set the initial light before a material is trained. The first process does this for all."""
    if not run.light_solver.seeks_start:
        return
    model = run.model
    decisions: list[Decision] = []
    if run.fabric.is_global_zero:
        run.reporter.say("fitting light and material at selected places, to decide on effects …")
        seed_stream(run.config.train.seed, Stream.LIGHT, step)
        review = review_light(run.plan, model, run.pixels, step, _max_light_pixels(run))
        decisions, first = review.decisions, review.first
        _report(run, decisions)
        if first is not None:
            run.reporter.say(first.summary())
            evidence = start_with(model, run.light_solver, first)
            note_fit(run.fits, evidence, model.lamps.count, step)
            _report(run, record_lamps(run.plan, evidence, model.lamps.count, step))
    _share_light(run)
    _share_decisions(run, decisions)


def fit_poses(run: Training, position: StagePosition, step: int) -> None:
    """When it is due, fit the poses of the training cameras, after a decision whether that is needed.

    The first process does this for all.
    """
    model, poses = run.model, run.model.poses
    if poses is None or not is_fit_due(model.config.train.pose_fits, position):
        return
    decisions: list[Decision] = []
    motion = poses.motion
    if run.fabric.is_global_zero:
        with timed("checks", undivided=True):
            seed_stream(run.config.train.seed, Stream.POSES, step)
            decisions = review_poses(run.plan, model, run.given.pixels, step)
            if run.plan.is_on("poses"):
                centers = camera_centers(run.given.pixels.capture).to(motion.shift)
                motion = next_motion(model, run.given.pixels, motion, centers)
        _report(run, decisions)
    _share_decisions(run, decisions)
    poses.set(run.fabric.broadcast(motion))
    apply_poses(run)


def apply_poses(run: Training) -> None:
    """Give all training pixels the rays of the corrected cameras."""
    poses, given = run.model.poses, run.given
    if poses is None:
        return
    run.pixels = given.pixels.posed(corrected(given.pixels.capture, poses))
    run.quality.pixels = poses.motion.of(given.held_back)
    if given.checked is not None:
        run.watch.pixels = poses.motion.of(given.checked)


def improve_half_trained(run: Training, position: StagePosition, step: int) -> None:
    """When it is due, correct the scale of light and material, and review metals (`effects.review`).

    This may change the light and train the BRDF field. The first process does this for all.
    """
    model, max_pixels = run.model, _max_light_pixels(run)
    if max_pixels < MIN_PIXELS or not is_comparison_due(model, position):
        return
    decisions: list[Decision] = []
    may_change = model.brdf.metals or run.plan.is_open("metals") or run.light_solver.scale_is_free
    if run.fabric.is_global_zero and may_change:
        with timed("light_fits", undivided=True):
            seed_stream(run.config.train.seed, Stream.SEARCH, step)
            places = light_places(model, run.pixels, max_pixels)
            decisions = _improve_at(places, run, is_search_due(position), step)
        _report(run, decisions)
    _share_light(run)
    _share_decisions(run, decisions)
    if run.fabric.world_size > 1:
        model.brdf.load_state_dict(run.fabric.broadcast(model.brdf.state_dict()))


def _improve_at(places: Places, run: Training, with_search: bool, step: int) -> list[Decision]:
    """`improve_half_trained` at given places."""
    improved = improve_material(run.model, run.light_solver, places, with_search)
    if improved is None:
        return []
    for summary in improved.summaries:
        run.reporter.say(summary)
    return review_metals(run.plan, run.model, improved.lit, step) if with_search else []


def _max_light_pixels(run: Training) -> int:
    """Maximum number of pixels for the search of the initial light; a budget may limit it."""
    planned = None if run.pace is None else run.pace.plan.light_pixels
    return MAX_PIXELS if planned is None else planned


def _review_effects(run: Training, step: int, review: Review, stream: Stream) -> None:
    """Decide open effects by evidence. The first process does this for all.

    Args:
        run: the training.
        step: number of steps trained so far.
        review: takes the measurements.
        stream: the random numbers of these measurements.
    """
    if not needs_surface(run.plan):
        return
    decisions: list[Decision] = []
    if run.fabric.is_global_zero:
        seed_stream(run.config.train.seed, stream, step)
        decisions = review(run.plan, run.model, run.pixels, step)
        _report(run, decisions)
    _share_decisions(run, decisions)


def _share_decisions(run: Training, decisions: Sequence[Decision]) -> None:
    """Apply the decisions of the first process in all processes."""
    decisions = run.fabric.broadcast(decisions)
    if not run.fabric.is_global_zero:
        run.plan.decisions += decisions
    apply_plan(run)


def apply_plan(run: Training) -> None:
    """Apply the plan of effects to the model and the light solver; it may remove the joint stage."""
    config = run.plan.config
    if not config.train.joint_steps:
        run.config = dataclasses.replace(
            run.config, train=dataclasses.replace(run.config.train, joint_steps=0)
        )
    run.model.use(config)
    run.light_solver.use(config.light, run.model.lobe)


def _report(run: Training, decisions: Sequence[Decision]) -> None:
    """Print decisions on effects, a line each."""
    for decision in decisions:
        run.reporter.say(f"effects: {decision.effect} {'on' if decision.on else 'off'}, {decision.reason}")
