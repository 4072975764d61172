"""Measure the costs of a training on this machine and capture, with a few steps of each stage.

A trial trains a separate model on four views for a few steps of each stage and two small fits of the light,
and renders small previews. The time of the report, which would take too long, is estimated from that of a
preview. The costs change during training, because a sphere or a hull is rendered at another speed than the
final geometry; the plan is therefore revised from measured times (`budget.plan`).
"""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import dataclass, field, replace

import torch

from neilfpp_method.budget.plan import Costs, StageCost
from neilfpp_method.data.capture import Capture
from neilfpp_method.data.pixels import PixelDataset
from neilfpp_method.data.scaling import PIXELS_OF_A_VIEW, at_scale, scale_for_pixels
from neilfpp_method.effects.first_light import seconds_of_pixel
from neilfpp_method.effects.material import JUDGED, seconds_of_evidence
from neilfpp_method.effects.material_search import SEARCH_AT, SEARCH_SHARE
from neilfpp_method.effects.plan import Plan
from neilfpp_method.effects.request import EffectRequest
from neilfpp_method.effects.review import (
    MAX_PIXELS,
    MIN_PIXELS,
    MIN_TRAIN_VIEWS,
    record_facts,
    review_surface,
)
from neilfpp_method.health.measure import measure_surface
from neilfpp_method.health.watch import CHECKED_PIXELS
from neilfpp_method.lighting.solver import LightSolver, NothingToSolve
from neilfpp_method.model import NeilfModel
from neilfpp_method.schedule import Stage, StagePosition, active_losses, stage_steps, weigh
from neilfpp_method.settings.plain import changed
from neilfpp_method.settings.types import NeilfConfig
from neilfpp_method.train.build import build_model, scene_facts, show_known_light
from neilfpp_method.train.optimizer import make_optimizer, seed_step, set_rates
from neilfpp_method.train.preview import preview_pixels

__all__ = ["Trial", "run_trial"]

VIEWS = 4
"""Number of training views that a trial reads."""
WARM_STEPS = 2
"""Steps of a stage that are not timed, because they compile and allocate."""
MIN_STEPS = 4
"""Minimum number of timed steps of a stage."""
MAX_STEPS = 40
"""Maximum number of timed steps of a stage."""
FIT_EVERY = 2
"""Steps between two fits of the light in a trial."""
FIT_PART = 8
"""A fit of a trial uses one in this many points, because a full first fit takes as long as a hundred steps.
The time of a fit is assumed to be proportional to the number of points.
"""
TRIAL_HIT_SHARE = 1e-3
"""Minimum concentration of a hit in a trial. The density of an untrained field is spread out, so with the
value of the settings no point would be shaded and no light fitted.
"""
WARM_RAYS = 32
"""Number of rays that are rendered before the timing starts, so that work that a picture needs only once is
not timed.
"""
PICTURE_RAYS = 1024
"""Number of rays that are timed to estimate the time of a preview."""
REPORT = 12.0
"""Time of the report as a multiple of that of a preview (estimate). A preview has an eighth of the pixels of
the report's views; the rest is for the surface of the report.
"""


@dataclass(frozen=True)
class Trial:
    """The result of a trial.

    Attributes:
        costs: costs of the training.
        places: the part of these costs that measurements at places take, in seconds; 0 if there are none.
        light_pixels: number of pixels for which the search of the initial light has time; 0 if there is no
            time for it; None if the training does not search.
    """

    costs: Costs
    places: float
    light_pixels: int | None


@dataclass
class _Seconds:
    """Times of the steps and of the fits of a stage."""

    steps: list[float] = field(default_factory=list)
    fits: list[float] = field(default_factory=list)


def run_trial(
    capture: Capture,
    config: NeilfConfig,
    request: EffectRequest,
    device: torch.device,
    limit: float,
    most_for_places: float,
    most_for_light: float,
    report: bool,
    wait: Callable[[], object] = lambda: None,
) -> Trial:
    """Measure the costs of a training.

    Args:
        capture: the capture. Large views are read at a smaller size, which does not affect the time of a
            step.
        config: the settings; the steps of its stages are used as proportions.
        request: the value of `--effects`.
        device: the device of the training.
        limit: approximate time that the steps of all stages may take together, in seconds.
        most_for_places: maximum time of the measurements at places, in seconds. If they would take more they
            are left out.
        most_for_light: maximum time of the search for the initial light, in seconds. It determines the number
            of pixels of the search.
        report: whether the command ends by writing the report.
        wait: returns when the device has finished its work.
    """
    small = replace(capture, views=_some(capture))
    small = at_scale(small, scale_for_pixels(small.views, PIXELS_OF_A_VIEW * len(small.views)))
    pixels = PixelDataset(small, small.train_views, device)
    plan = Plan.begin(request, config)
    facts = scene_facts(small, pixels, config)
    record_facts(plan, facts)
    config = plan.config_of_model
    trial_config, fit_scale = changed(config, {"shading.hit_share": TRIAL_HIT_SHARE}), 1.0
    if config.light.kind != "free":
        points = max(1, config.light.fit.points // FIT_PART)
        trial_config = changed(trial_config, {"light.fit.every": FIT_EVERY, "light.fit.points": points})
        fit_scale = config.light.fit.points / points
    seed_step(config.train.seed, step=-1)
    model = build_model(small, facts, trial_config).to(device).train()
    show_known_light(model)
    solver = model.light_solver().to(device)
    optimizer = make_optimizer(model, config.optimizer)

    lengths = {stage: steps for stage, steps in stage_steps(config.train).items() if steps}
    measures_places = model.lobe is not None and any(plan.is_open(name) for name in JUDGED)
    place_seconds = seconds_of_evidence(device) if measures_places else 0.0
    with_material = [stage for stage in lengths if model.stages[stage].moves_material]
    if place_seconds * len(with_material) > most_for_places:
        place_seconds = 0.0
    light_pixels, light = None, 0.0
    if solver.seeks_start and len(capture.train_views) >= MIN_TRAIN_VIEWS and with_material:
        rate = seconds_of_pixel(device, plan.is_open("long-tails"), plan.is_open("metals"))
        light_pixels = min(MAX_PIXELS, int(most_for_light / rate))
        light_pixels = 0 if light_pixels < MIN_PIXELS else light_pixels
        light = rate * light_pixels
    surface = _timed(lambda: _review_surface(plan, model, pixels), wait)
    costs, picture, fitted = {}, 0.0, False
    for stage, steps in lengths.items():
        moves = model.stages[stage].moves_material
        seconds = _steps(model, solver, optimizer, pixels, trial_config, stage, limit / len(lengths), wait)
        model.eval()
        picture = _picture_seconds(model, small, pixels, moves, wait)
        sample = pixels.sample(CHECKED_PIXELS, gradients=False)
        health_check = _timed(lambda sample=sample, moves=moves: measure_surface(model, sample, moves), wait)
        model.train()
        first, later = (seconds.fits[:1] or [0.0])[0], (seconds.fits[-1:] or [0.0])[0]
        every = 1 if config.light.kind == "free" else config.light.fit.every
        step = sum(seconds.steps) / len(seconds.steps)
        begins = moves and not fitted
        # The search for the initial light ends with the solver's first fit. Without the search, the first fit
        # is made within the stage.
        first_fit = fit_scale * first if begins else 0.0
        before = (light + first_fit if light_pixels else 0.0) if begins else 0.0
        searches = len(SEARCH_AT) * SEARCH_SHARE * light if stage is Stage.MATERIAL_INIT else 0.0
        costs[stage.value] = StageCost(
            steps,
            step,
            fit=fit_scale * later / every + searches / steps,
            start=(surface + place_seconds if moves else 0.0) + before,
            end=picture + 2 * health_check,
            first_fit=0.0 if light_pixels else first_fit,
        )
        fitted = fitted or moves
    places = place_seconds * len(with_material)
    return Trial(Costs(costs, REPORT * picture if report else 0.0), places, light_pixels)


def _some(capture: Capture) -> tuple:
    """The first test view, for the preview, and about `VIEWS` evenly spaced training views."""
    views = capture.train_views
    return (*capture.test_views[:1], *views[:: -(-len(views) // VIEWS)])


def _steps(
    model: NeilfModel,
    solver: LightSolver,
    optimizer: torch.optim.Optimizer,
    pixels: PixelDataset,
    config: NeilfConfig,
    stage: Stage,
    limit: float,
    wait: Callable[[], object],
) -> _Seconds:
    """Time steps of a stage as `train.loop` takes them.

    It ends when the time limit has passed and, if the stage fits the light, two fits have been made, or after
    `MAX_STEPS` timed steps.
    """
    model.freeze_for(stage)
    times, began = _Seconds(), time.perf_counter()
    fits = model.stages[stage].moves_material and not isinstance(solver, NothingToSolve)
    gradients = "smoothness" in active_losses(stage, config, model.stages)
    for number in range(WARM_STEPS + MAX_STEPS):
        step_began = time.perf_counter()
        seed_step(config.train.seed, number)
        set_rates(optimizer, config.optimizer, StagePosition(stage, number, WARM_STEPS + MAX_STEPS))
        computed = model.step(pixels.sample(config.train.rays, gradients), stage)
        optimizer.zero_grad(set_to_none=True)
        total = weigh(computed.terms, active_losses(stage, config, model.stages)).loss
        if total.requires_grad:
            total.backward()
            optimizer.step()
        wait()
        if number >= WARM_STEPS:
            times.steps.append(time.perf_counter() - step_began)
        solver.observe(computed)
        if solver.due:
            times.fits.append(_timed(lambda: solver.solve(model.brdf, model.scene), wait))
        if (
            number >= WARM_STEPS + MIN_STEPS
            and time.perf_counter() - began > limit
            and (not fits or len(times.fits) > 1)
        ):
            break
    return times


def _review_surface(plan: Plan, model: NeilfModel, pixels: PixelDataset) -> None:
    """Measure evidence at the surface; that at places takes longer than a trial."""
    if plan.is_open("inter-reflection"):
        review_surface(Plan(plan.request, plan.settings, [*plan.decisions]), model, pixels, 0)


def _picture_seconds(
    model: NeilfModel,
    capture: Capture,
    pixels: PixelDataset,
    with_material: bool,
    wait: Callable[[], object],
) -> float:
    """Estimate the time of the picture at the end of a stage from that of some of its rays."""
    warm, timed = (pixels.sample(count, gradients=False).rays for count in (WARM_RAYS, PICTURE_RAYS))
    once = _timed(lambda: model.maps(warm, with_material), wait)
    part = _timed(lambda: model.maps(timed, with_material), wait)
    return once + part * preview_pixels(capture) / PICTURE_RAYS


def _timed(work: Callable[[], object], wait: Callable[[], object]) -> float:
    """Time of a function call including its work on the device, in seconds."""
    began = time.perf_counter()
    work()
    wait()
    return time.perf_counter() - began
