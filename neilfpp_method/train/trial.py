"""Measure the costs of a training on this machine and capture, with a few steps of each stage.

A trial trains a separate model on four views for a few steps of each stage and two small fits of the light,
and renders small previews. The time of the report, which would take too long, is estimated from that of a
preview. The costs change during training, because a sphere or a hull is rendered at another speed than the
final geometry; the plan is therefore revised from measured times (`budget.plan`).
"""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace

import torch

from neilfpp_method.budget.plan import Costs, StageCost
from neilfpp_method.data.capture import Capture
from neilfpp_method.data.pixels.dataset import PixelDataset
from neilfpp_method.data.scaling import PIXELS_OF_A_VIEW, at_scale, scale_for_pixels
from neilfpp_method.data.views import View
from neilfpp_method.effects.evidence.material import EFFECTS_AT_PLACES, seconds_of_evidence
from neilfpp_method.effects.first_light import seconds_of_pixel
from neilfpp_method.effects.places.search import COMPARISONS, SEARCH_SHARE
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
from neilfpp_method.train.build import initial_model, scene_facts
from neilfpp_method.train.device import waiting
from neilfpp_method.train.optimizer import make_optimizer, seed_step, set_rates
from neilfpp_method.train.patches import show_patches
from neilfpp_method.train.preview import preview_pixels

__all__ = ["Trial", "TrialLimits", "TrialTooLong", "Workload", "run_trial"]

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
PREVIEWS_PER_REPORT = 12.0
"""Time of the report as a multiple of that of a preview (estimate). A preview has an eighth of the pixels of
the report's views; the rest is for the surface of the report.
"""


@dataclass(frozen=True)
class Workload:
    """A training whose costs are wanted.

    Attributes:
        capture: the capture.
        config: the settings.
        effects: the value of `--effects`.
        device: the device of the training.
        report: whether the command ends by writing the report.
    """

    capture: Capture
    config: NeilfConfig
    effects: EffectRequest
    device: torch.device
    report: bool


@dataclass(frozen=True)
class TrialLimits:
    """Times, in seconds.

    Attributes:
        steps: approximate time that the steps of all stages of the trial may take together.
        places: maximum time of the measurements at places in the training. If they would take more they are
            left out.
        light: maximum time of the search for the initial light in the training. It determines the number of
            pixels of the search.
        has_time: whether the trial may go on; called before each part of the work.
    """

    steps: float
    places: float
    light: float
    has_time: Callable[[], bool] = lambda: True

    def check_time(self) -> None:
        """Raise `TrialTooLong` if the trial may not go on."""
        if not self.has_time():
            raise TrialTooLong


class TrialTooLong(Exception):
    """The trial takes longer than it may."""


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


@dataclass(frozen=True)
class _Setup:
    """The model that a trial trains, and what it is trained on.

    Attributes:
        capture: some views of the capture, at a reduced size.
        pixels: the training pixels of these views.
        config: the settings of the training, from which a trial differs as `trial_config` says.
        trial_config: the settings of the trial: more rays are shaded, and fits of the light are small.
        plan: the effects of the training.
        model: the model, on the device of the training.
        solver: its light solver.
        optimizer: its optimizer.
        wait: returns when the device has finished its work.
    """

    capture: Capture
    pixels: PixelDataset
    config: NeilfConfig
    trial_config: NeilfConfig
    plan: Plan
    model: NeilfModel
    solver: LightSolver
    optimizer: torch.optim.Optimizer
    wait: Callable[[], object]

    def seconds(self, work: Callable[[], object]) -> float:
        """Time of a function call including its work on the device."""
        began = time.perf_counter()
        work()
        self.wait()
        return time.perf_counter() - began


@dataclass
class _StageTimes:
    """Times measured in a stage, in seconds: each step, each fit, and the picture and the health check at its
    end.
    """

    steps: list[float] = field(default_factory=list)
    fits: list[float] = field(default_factory=list)
    picture: float = 0.0
    health_check: float = 0.0


@dataclass(frozen=True)
class _Search:
    """The search for the initial light.

    Attributes:
        pixels: number of pixels; None if the training does not search, 0 if there is too little time.
        seconds: time of the search.
    """

    pixels: int | None = None
    seconds: float = 0.0


def run_trial(work: Workload, limits: TrialLimits) -> Trial:
    """Measure the costs of a training.

    Args:
        work: the training. Large views are read at a smaller size, which does not affect the time of a step.
            The steps of the stages are used as proportions.
        limits: how long the trial, and parts of the training, may take.

    Raises:
        TrialTooLong: see `TrialLimits.has_time`.
    """
    limits.check_time()
    setup = _set_up(work)
    lengths = {stage: steps for stage, steps in stage_steps(setup.config.train).items() if steps}
    with_material = [stage for stage in lengths if setup.model.stages[stage].trains_material]
    places = _seconds_of_places(setup)
    if places * len(with_material) > limits.places:
        places = 0.0
    search = _plan_search(setup, len(work.capture.train_views), limits.light) if with_material else _Search()
    surface = setup.seconds(lambda: _review_surface(setup.plan, setup.model, setup.pixels))
    costs, times = {}, _StageTimes()
    for stage, steps in lengths.items():
        times = _measure_stage(setup, stage, limits.steps / len(lengths), limits.check_time)
        searches = _search_count(stage, with_material) * SEARCH_SHARE * search.seconds
        cost = _cost_of_steps(setup, steps, times, searches)
        if stage in with_material:
            cost = replace(cost, start=surface + places)
        if with_material and stage is with_material[0]:
            cost = _with_first_light(cost, search, _fit_seconds(setup, times.fits[:1]))
        costs[stage.value] = cost
    report = PREVIEWS_PER_REPORT * times.picture if work.report else 0.0
    return Trial(Costs(costs, report), places * len(with_material), search.pixels)


def _search_count(stage: Stage, with_material: Sequence[Stage]) -> int:
    """Number of searches at places in a stage, and after the last stage with material."""
    compared = len(COMPARISONS) if stage is Stage.MATERIAL_INIT else 0
    return compared + (1 if stage in with_material[-1:] else 0)


def _cost_of_steps(setup: _Setup, steps: int, times: _StageTimes, searches: float) -> StageCost:
    """The cost of the steps of a stage and of its end, without that of its start.

    Args:
        setup: the settings of the training and of the trial.
        steps: number of steps of the stage.
        times: the times that were measured in the stage.
        searches: time of the searches for materials in the stage, in seconds.
    """
    fit = _fit_seconds(setup, times.fits[-1:]) / _steps_per_fit(setup.config)
    return StageCost(
        steps,
        step=sum(times.steps) / len(times.steps),
        fit=fit + searches / steps,
        end=times.picture + 2 * times.health_check,
    )


def _with_first_light(cost: StageCost, search: _Search, first_fit: float) -> StageCost:
    """Add the search for the initial light and the first fit to the cost of the first stage with material."""
    if search.pixels:
        # The search ends with the solver's first fit.
        return replace(cost, start=cost.start + (search.seconds + first_fit))
    # Without the search, the first fit is made within the stage.
    return replace(cost, first_fit=first_fit)


def _set_up(work: Workload) -> _Setup:
    small = replace(work.capture, views=_some(work.capture))
    small = at_scale(small, scale_for_pixels(small.views, PIXELS_OF_A_VIEW * len(small.views)))
    pixels = PixelDataset(small, small.train_views, work.device)
    plan = Plan.begin(work.effects, work.config)
    facts = scene_facts(small, pixels, work.config)
    record_facts(plan, facts)
    config = plan.config_of_model
    trial_config = changed(config, {"shading.hit_share": TRIAL_HIT_SHARE})
    if config.light.kind != "free":
        points = max(1, config.light.fit.points // FIT_PART)
        trial_config = changed(trial_config, {"light.fit.every": FIT_EVERY, "light.fit.points": points})
    model = initial_model(small, facts, trial_config).to(work.device).train()
    solver = model.light_solver().to(work.device)
    optimizer = make_optimizer(model, config.optimizer)
    wait = waiting(work.device) or (lambda: None)
    return _Setup(small, pixels, config, trial_config, plan, model, solver, optimizer, wait)


def _some(capture: Capture) -> tuple[View, ...]:
    """The first test view, for the preview, and about `VIEWS` evenly spaced training views."""
    views = capture.train_views
    return (*capture.test_views[:1], *views[:: -(-len(views) // VIEWS)])


def _seconds_of_places(setup: _Setup) -> float:
    """Time of the measurements at places before a stage, in seconds; 0 if no effect needs them."""
    needed = setup.model.lobe is not None and any(setup.plan.is_open(name) for name in EFFECTS_AT_PLACES)
    return seconds_of_evidence(setup.pixels.device) if needed else 0.0


def _plan_search(setup: _Setup, views: int, limit: float) -> _Search:
    """Fit the search for the initial light of a training on so many views into a time limit in seconds."""
    if not setup.solver.seeks_start or views < MIN_TRAIN_VIEWS:
        return _Search()
    plan = setup.plan
    rate = seconds_of_pixel(setup.pixels.device, plan.is_open("long-tails"), plan.is_open("metals"))
    pixels = min(MAX_PIXELS, int(limit / rate))
    pixels = 0 if pixels < MIN_PIXELS else pixels
    return _Search(pixels, rate * pixels)


def _fit_seconds(setup: _Setup, measured: Sequence[float]) -> float:
    """Time of a fit in the training, from the fit that a trial measured, if any."""
    if not measured or setup.config.light.kind == "free":
        return 0.0
    return measured[0] * setup.config.light.fit.points / setup.trial_config.light.fit.points


def _steps_per_fit(config: NeilfConfig) -> int:
    return 1 if config.light.kind == "free" else config.light.fit.every


def _measure_stage(setup: _Setup, stage: Stage, limit: float, check_time: Callable[[], None]) -> _StageTimes:
    """Time the steps of a stage for about `limit` seconds, and its picture and health check."""
    model, with_material = setup.model, setup.model.stages[stage].trains_material
    show_patches(model, setup.pixels, stage)
    times = _train_steps(setup, stage, limit, check_time)
    check_time()
    model.eval()
    times.picture = _picture_seconds(setup, with_material)
    sample = setup.pixels.sample(CHECKED_PIXELS, gradients=False)
    times.health_check = setup.seconds(lambda: measure_surface(model, sample, with_material))
    model.train()
    return times


def _train_steps(setup: _Setup, stage: Stage, limit: float, check_time: Callable[[], None]) -> _StageTimes:
    """Time steps of a stage as `train.loop` takes them.

    It ends when the time limit has passed and, if the stage fits the light, two fits have been made, or after
    `MAX_STEPS` timed steps.
    """
    model, solver, optimizer, config = setup.model, setup.solver, setup.optimizer, setup.trial_config
    model.freeze_for(stage)
    times, began = _StageTimes(), time.perf_counter()
    fits = model.stages[stage].trains_material and not isinstance(solver, NothingToSolve)
    gradients = "smoothness" in active_losses(stage, config, model.stages)
    for number in range(WARM_STEPS + MAX_STEPS):
        check_time()
        step_began = time.perf_counter()
        seed_step(config.train.seed, number)
        set_rates(optimizer, config.optimizer, StagePosition(stage, number, WARM_STEPS + MAX_STEPS))
        computed = model.step(setup.pixels.sample(config.train.rays, gradients), stage)
        optimizer.zero_grad(set_to_none=True)
        total = weigh(computed.terms, active_losses(stage, config, model.stages)).loss
        if total.requires_grad:
            total.backward()
            optimizer.step()
        setup.wait()
        if number >= WARM_STEPS:
            times.steps.append(time.perf_counter() - step_began)
        solver.observe(computed)
        if solver.due:
            times.fits.append(setup.seconds(lambda: solver.solve(model.brdf, model.scene)))
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


def _picture_seconds(setup: _Setup, with_material: bool) -> float:
    """Estimate the time of the picture at the end of a stage from that of some of its rays."""
    render = setup.model.maps if with_material else setup.model.host_maps
    warm, timed = (setup.pixels.sample(count, gradients=False).rays for count in (WARM_RAYS, PICTURE_RAYS))
    once = setup.seconds(lambda: render(warm))
    part = setup.seconds(lambda: render(timed))
    return once + part * preview_pixels(setup.capture) / PICTURE_RAYS
