"""What a training costs on this machine and this capture: a few steps of each stage, measured and thrown
away.

A trial trains a model of its own on four views, with a few steps of each stage and two small fits of the
light, and makes small pictures. What it cannot try in seconds is estimated from that: the report, from the
pictures. Geometry that is still a sphere, or a hull, costs other than a finished one; so a plan is made again
by the clock (`budget.plan`).
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
from neilfpp_method.effects.asked import Asked
from neilfpp_method.effects.first_light import seconds_of_pixel
from neilfpp_method.effects.looks import (
    FEWEST_PIXELS,
    MIN_PHOTOGRAPHS,
    MOST_PIXELS,
    look_at_surface,
    note_facts,
)
from neilfpp_method.effects.material import JUDGED, seconds_of_evidence
from neilfpp_method.effects.plan import Decision, Plan
from neilfpp_method.health.look import look
from neilfpp_method.health.watch import LOOKED_AT
from neilfpp_method.lighting.solver import LightSolver, NothingToSolve
from neilfpp_method.model import NeilfModel
from neilfpp_method.schedule import Stage, StagePosition, active_losses, stage_steps, weigh
from neilfpp_method.settings.plain import changed
from neilfpp_method.settings.types import NeilfConfig
from neilfpp_method.train.build import build_model, scene_facts, show_known_light
from neilfpp_method.train.optimizer import make_optimizer, seed_step, set_rates
from neilfpp_method.train.preview import preview_pixels

__all__ = ["Trial", "try_out"]

VIEWS = 4
"""Training views that a trial reads."""
WARM_STEPS, MIN_STEPS, MAX_STEPS = 2, 4, 40
"""Steps of a stage that are not counted, as they compile and allocate; and how many are counted."""
FIT_EVERY, FIT_PART = 2, 8
"""Steps between the fits of a trial, and one in how many points they have: a whole first fit takes as long as
a hundred steps. Time and points are taken to be proportional.
"""
LOOSE = 1e-3
"""Least concentration of a hit in a trial. The surface of an untrained field is fog, and with the least
concentration of the settings nothing would be shaded, and no light be fitted.
"""
WARM_RAYS, PICTURE_RAYS = 32, 1024
"""Rays that are rendered before those that are timed, and those; a picture is estimated from their time."""
REPORT = 12.0
"""Time of the report over that of a picture, which has an eighth of the pixels of the report's views; the
rest is for its surface. An estimate, not measured.
"""


@dataclass(frozen=True)
class Trial:
    """What was measured.

    Attributes:
        costs: of a training.
        places: of them, those of looks at places; 0 where there are none.
        light_pixels: pixels that the places of the first light may have; 0 if there is no time for it; None
            if the training does not look for it.
    """

    costs: Costs
    places: float
    light_pixels: int | None


@dataclass
class _Seconds:
    steps: list[float] = field(default_factory=list)
    fits: list[float] = field(default_factory=list)


def try_out(
    capture: Capture,
    config: NeilfConfig,
    asked: Asked,
    device: torch.device,
    limit: float,
    most_for_places: float,
    most_for_light: float,
    report: bool,
    wait: Callable[[], object] = lambda: None,
) -> Trial:
    """Measure what a training costs.

    Args:
        capture: whose views are read as they are, or smaller where they are large: that changes no step.
        config: of the training; its steps are the proportions of the stages.
        asked: which effects are simulated.
        device: where to compute.
        limit: seconds that the steps of all stages may take together, about.
        most_for_places: seconds that looks at places may take; if they take more there are none.
        most_for_light: seconds that the search for the first light may take; it is given as many pixels as
            fit.
        report: whether the run will end with its page.
        wait: returns when the device has done its work.
    """
    small = replace(capture, views=_some(capture))
    small = at_scale(small, scale_for_pixels(small.views, PIXELS_OF_A_VIEW * len(small.views)))
    pixels = PixelDataset(small, small.train_views, device)
    plan = Plan.begin(asked, config)
    facts = scene_facts(small, pixels, config)
    note_facts(plan, facts)
    config = plan.config_of_model
    often, larger = changed(config, {"shading.hit_share": LOOSE}), 1.0
    if config.light.kind != "free":
        points = max(1, config.light.fit.points // FIT_PART)
        often = changed(often, {"light.fit.every": FIT_EVERY, "light.fit.points": points})
        larger = config.light.fit.points / points
    seed_step(config.train.seed, step=-1)
    model = build_model(small, facts, often).to(device).train()
    show_known_light(model)
    solver = model.light_solver().to(device)
    optimizer = make_optimizer(model, config.optimizer)

    lengths = {stage: steps for stage, steps in stage_steps(config.train).items() if steps}
    judged = model.lobe is not None and any(plan.is_open(name) for name in JUDGED)
    place_look = seconds_of_evidence(device) if judged else 0.0
    with_material = [stage for stage in lengths if model.stages[stage].moves_material]
    if place_look * len(with_material) > most_for_places:
        place_look = 0.0
    light_pixels, light = None, 0.0
    if solver.seeks_start and len(capture.train_views) >= MIN_PHOTOGRAPHS and with_material:
        rate = seconds_of_pixel(device, plan.is_open("long-tails"))
        light_pixels = min(MOST_PIXELS, int(most_for_light / rate))
        light_pixels = 0 if light_pixels < FEWEST_PIXELS else light_pixels
        light = rate * light_pixels
    surface = _timed(lambda: _look_at_surface(plan, model, pixels), wait)
    costs, picture, fitted = {}, 0.0, False
    for stage, steps in lengths.items():
        moves = model.stages[stage].moves_material
        seconds = _steps(model, solver, optimizer, pixels, often, stage, limit / len(lengths), wait)
        model.eval()
        picture = _picture_seconds(model, small, pixels, moves, wait)
        seen = pixels.sample(LOOKED_AT, gradients=False)
        looked = _timed(lambda seen=seen, moves=moves: look(model, seen, moves), wait)
        model.train()
        first, later = (seconds.fits[:1] or [0.0])[0], (seconds.fits[-1:] or [0.0])[0]
        every = 1 if config.light.kind == "free" else config.light.fit.every
        step = sum(seconds.steps) / len(seconds.steps)
        begins = moves and not fitted
        # The search for the first light ends with the solver's first fit, which else comes within the stage.
        first_fit = larger * first if begins else 0.0
        before = (light + first_fit if light_pixels else 0.0) if begins else 0.0
        costs[stage.value] = StageCost(
            steps,
            step,
            fit=larger * later / every,
            start=(surface + place_look if moves else 0.0) + before,
            end=picture + 2 * looked,
            first_fit=0.0 if light_pixels else first_fit,
        )
        fitted = fitted or moves
    places = place_look * len(with_material)
    return Trial(Costs(costs, REPORT * picture if report else 0.0), places, light_pixels)


def _some(capture: Capture) -> tuple:
    """The first test view, for the picture, and some training views, evenly chosen."""
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
    """Steps of a stage as `train.loop` takes them, until the time is over and, where light is fitted, there
    were two fits; at most `MAX_STEPS` are counted.
    """
    model.freeze_for(stage)
    found, began = _Seconds(), time.perf_counter()
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
            found.steps.append(time.perf_counter() - step_began)
        solver.observe(computed)
        if solver.due:
            found.fits.append(_timed(lambda: solver.solve(model.brdf, model.scene), wait))
        if (
            number >= WARM_STEPS + MIN_STEPS
            and time.perf_counter() - began > limit
            and (not fits or len(found.fits) > 1)
        ):
            break
    return found


def _look_at_surface(plan: Plan, model: NeilfModel, pixels: PixelDataset) -> None:
    """Evidence of the surface but for that of places, which takes longer than a trial."""
    tried = [Decision(0, name, plan.is_on(name), "settings", "not tried out") for name in JUDGED]
    decided = [*plan.decisions, *tried]
    if plan.is_open("inter-reflection"):
        look_at_surface(Plan(plan.asked, plan.settings, decided), model, pixels, 0)


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
    began = time.perf_counter()
    work()
    wait()
    return time.perf_counter() - began
