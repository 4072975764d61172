"""The part of the loop that measures: effects and the initial light before a stage, fits of the light in it.

The first process measures and decides for all.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Sequence

from neilfpp_method.effects.evidence.poses import next_motion
from neilfpp_method.effects.following import follow, follow_fit
from neilfpp_method.effects.plan import Decision
from neilfpp_method.effects.review import MAX_PIXELS, review_poses
from neilfpp_method.schedule import StagePosition, stage_at
from neilfpp_method.structures import StepResult
from neilfpp_method.timing.ledger import timed
from neilfpp_method.train import deciding
from neilfpp_method.train.deciding import Subject
from neilfpp_method.train.light_record import note_fit
from neilfpp_method.train.optimizer import Stream, seed_stream
from neilfpp_method.train.patches import pose_patches
from neilfpp_method.train.poses import camera_centers, corrected, is_fit_due
from neilfpp_method.train.training import Training

__all__ = [
    "apply_plan",
    "apply_poses",
    "correct_final_scale",
    "fit_poses",
    "improve_half_trained",
    "observe_and_solve",
    "review_before_stage",
]


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
        note_fit(run.fits, evidence, run.model.lamps.count, step + 1)
        follow_fit(_subject(run), evidence, step + 1)
    _share_light(run)


def _share_light(run: Training) -> None:
    """Copy the light of the first process to all others."""
    if run.fabric.world_size > 1:
        for part in (run.model.light, run.model.lamps):
            part.load_state_dict(run.fabric.broadcast(part.state_dict()))


def review_before_stage(run: Training, step: int) -> None:
    """Take the measurements before a stage that trains material."""

    def measure(subject: Subject) -> None:
        evidence = deciding.review_before_material(subject, step)
        note_fit(run.fits, evidence, run.model.lamps.count, step)

    if run.model.stages[stage_at(step, run.config.train).stage].trains_material:
        _decide_for_all(run, measure)


def fit_poses(run: Training, position: StagePosition, step: int) -> None:
    """When it is due, fit the poses of the training cameras, after a decision whether that is needed.

    The first process does this for all.
    """
    model, poses = run.model, run.model.poses
    if poses is None or not is_fit_due(model.config.train.pose_fits, position):
        return
    motion = poses.motion

    def measure(subject: Subject) -> None:
        nonlocal motion
        with timed("checks", undivided=True):
            seed_stream(run.config.train.seed, Stream.POSES, step)
            follow(subject, review_poses(run.plan, model, run.given.pixels, step))
            if run.plan.is_on("poses"):
                centers = camera_centers(run.given.pixels.capture).to(motion.shift)
                motion = next_motion(model, run.given.pixels, motion, centers)

    _decide_for_all(run, measure)
    poses.set(run.fabric.broadcast(motion))
    apply_poses(run)


def apply_poses(run: Training) -> None:
    """Give all training pixels the rays of the corrected cameras."""
    poses, given = run.model.poses, run.given
    if poses is None:
        return
    run.pixels = given.pixels.posed(corrected(given.pixels.capture, poses))
    pose_patches(run.model, run.pixels)
    run.quality.pixels = poses.motion.of(given.held_back)
    if given.checked is not None:
        run.watch.pixels = poses.motion.of(given.checked)


def improve_half_trained(run: Training, position: StagePosition, step: int) -> None:
    """When it is due, correct the scale of light and material, and review metals.

    This may change the light and train the BRDF field. The first process does this for all.
    """

    def measure(subject: Subject) -> None:
        with timed("light_fits", undivided=True):
            deciding.improve_half_trained(subject, position, step)

    if deciding.is_improvement_due(_subject(run), position):
        _decide_for_all(run, measure)
        _share_material(run)


def correct_final_scale(run: Training, step: int) -> None:
    """Correct the scale of light and base colour after the last step. The first process does this for all."""
    _decide_for_all(run, lambda subject: deciding.correct_final_scale(subject, step))
    _share_material(run)


def _share_material(run: Training) -> None:
    """Copy the BRDF field of the first process to all others."""
    if run.fabric.world_size > 1:
        run.model.brdf.load_state_dict(run.fabric.broadcast(run.model.brdf.state_dict()))


def _subject(run: Training) -> Subject:
    """What is measured in a run, at most at so many places as its budget allows."""
    planned = None if run.pace is None else run.pace.plan.light_pixels
    return Subject(
        plan=run.plan,
        model=run.model,
        light_solver=run.light_solver,
        pixels=run.pixels,
        seed=run.config.train.seed,
        say=run.reporter.say,
        max_pixels=MAX_PIXELS if planned is None else planned,
    )


def _decide_for_all(run: Training, measure: Callable[[Subject], None]) -> None:
    """Measure in the first process, and use its light and its decisions in all processes."""
    known = len(run.plan.decisions)
    if run.fabric.is_global_zero:
        measure(_subject(run))
    _share_light(run)
    _share_decisions(run, run.plan.decisions[known:])


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
