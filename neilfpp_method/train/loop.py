"""The training loop: three stages, one optimiser, and a step that depends on seed and number alone."""

from __future__ import annotations

import dataclasses
import math
import shlex
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path

import torch
from lightning_fabric import Fabric
from torch import Tensor

from neilfpp_method.data.pixels import PixelDataset
from neilfpp_method.effects.first_light import start_with
from neilfpp_method.effects.looks import (
    MOST_PIXELS,
    after_fit,
    look_at_light,
    look_at_surface,
    wants_surface,
)
from neilfpp_method.effects.plan import Decision, Plan
from neilfpp_method.errors import Diverged, Stopped, UserError
from neilfpp_method.health.guard import MAX_SKIPPED_IN_A_ROW
from neilfpp_method.health.watch import Watch
from neilfpp_method.lighting.solver import LightSolver
from neilfpp_method.model import NeilfModel
from neilfpp_method.schedule import (
    Stage,
    StagePosition,
    Total,
    active_losses,
    stage_at,
    stage_steps,
    total_steps,
    weigh,
)
from neilfpp_method.settings.facts import RadianceUnits
from neilfpp_method.settings.types import NeilfConfig
from neilfpp_method.structures import LossTerms, StepResult
from neilfpp_method.timing.ledger import Ledger, doing
from neilfpp_method.train.effects_record import read_plan, write_plan
from neilfpp_method.train.health_record import read_findings, write_findings
from neilfpp_method.train.light_record import LightFit, note_fit, read_fits, write_fits
from neilfpp_method.train.optimizer import gradient_norms, make_optimizer, seed_step, set_rates
from neilfpp_method.train.pace import Pace
from neilfpp_method.train.progress import Reporter
from neilfpp_method.train.quality import Quality, read_looks, write_looks
from neilfpp_method.train.run import load_checkpoint, load_weights, read_json, save_checkpoint, write_json
from neilfpp_method.train.skipped import Moment, keep_step
from neilfpp_method.train.work_record import write_work

__all__ = ["Training", "train"]

LOG_EVERY = 50
"""Steps between TensorBoard scalars: a thousand points of a curve in the longest training."""


@dataclass
class Training:
    """A run in progress. `continue_with` is the command that goes on with it after a stop, `pace` keeps it
    to a budget; none: it has none.
    """

    path: Path
    config: NeilfConfig
    model: NeilfModel
    pixels: PixelDataset
    fabric: Fabric
    reporter: Reporter
    should_stop: Callable[[], bool]
    preview: Callable[[NeilfModel, Stage], None]
    continue_with: str
    light_solver: LightSolver
    watch: Watch
    plan: Plan
    quality: Quality
    ledger: Ledger = field(default_factory=Ledger)
    pace: Pace | None = None
    fits: list[LightFit] = field(default_factory=list)
    skipped: int = 0
    skipped_in_a_row: int = 0
    seconds: dict[str, float] = field(default_factory=dict)


def train(run: Training) -> None:
    """Train from the last checkpoint, or from the start, to the end.

    Raises:
        Stopped: `run.should_stop` said so; the state is saved, and training continues from it bit for bit.
        Diverged: ten steps in a row were not finite; the last good checkpoint is kept.
    """
    model = run.model.to(run.fabric.device).train()
    run.light_solver.to(run.fabric.device)
    optimizer = make_optimizer(model, run.config.optimizer)
    step = _restore(run, optimizer)
    optimizer = run.fabric.setup_optimizers(optimizer)
    if step == 0:
        _look(run, model, 0)
    while step < total_steps(run.config.train):
        position = stage_at(step, run.config.train)
        step = _train_stage(run, model, optimizer, step, position)
        if run.fabric.is_global_zero:
            with doing("looks", apart=True):
                run.watch.after_stage(model, model.stages[position.stage], run.skipped, step)
        if step < total_steps(run.config.train):
            with doing("looks", apart=True):
                _look(run, model, step)
        _save(run, optimizer, step, also=position.stage.value)
        with doing("looks", apart=True):
            model.eval()
            run.preview(model, position.stage)
            model.train()


def _train_stage(
    run: Training, model: NeilfModel, optimizer: torch.optim.Optimizer, step: int, position: StagePosition
) -> int:
    """The rest of a stage. Returns the number of the step that follows it."""
    settings = run.config.train
    stage = position.stage
    model.freeze_for(stage)
    # Set up anew in each stage: data-parallel wrappers fix the set of moving parameters when they are made.
    wrapped = run.fabric.setup_module(model, move_to_device=False)
    run.ledger.enter(stage.value)
    run.reporter.begin_stage(stage.value, position.step, position.length)
    started = time.perf_counter()
    before = run.seconds.get(stage.value, 0.0)
    gradients = "smoothness" in active_losses(stage, model.config, model.stages)  # nothing else asks for them
    number, length = position.step, position.length
    while number < length:
        with run.ledger.step(number):
            seed_step(settings.seed, step, run.fabric.global_rank)
            at = StagePosition(stage, number, length)
            set_rates(optimizer, run.config.optimizer, at, background_waits=not run.model.facts.far_points)
            with doing("data"):
                batch = run.pixels.sample(settings.rays, gradients)
            moment = Moment.before_step(model, batch, at)
            computed = wrapped(batch, stage)
            total = weigh(computed.terms, active_losses(stage, model.config, model.stages, at.share))
            stop = _update(run, model, optimizer, computed.terms, total, moment, step)
            _solve_light(run, model, computed, step)
        run.watch.after_step(model.stages[stage], computed, step)
        number, step = number + 1, step + 1
        length = _keep_pace(run, StagePosition(stage, number, length), step)
        _look_at_quality(run, model, StagePosition(stage, number, length), step)
        run.seconds[stage.value] = before + time.perf_counter() - started
        if number == length:
            break  # The end of a stage is saved under its name, and a stop waits for that.
        if stop or step % settings.checkpoint_every == 0:
            _save(run, optimizer, step)
        if stop:
            raise Stopped(f"stopped after step {step}", f"continue with: {run.continue_with}")
    return step


def _keep_pace(run: Training, position: StagePosition, step: int) -> int:
    """Keep to the budget, where there is one. Returns how many steps the stage has."""
    if run.pace is None:
        return position.length
    kept = run.pace.keep(run.config.train, position, step)
    if kept is not run.config.train:
        run.config = dataclasses.replace(run.config, train=kept)
        run.reporter.lengthen(stage_steps(kept)[position.stage])
    return stage_steps(kept)[position.stage]


def _solve_light(run: Training, model: NeilfModel, computed: StepResult, step: int) -> None:
    """Show a step to the light solver, which sets the light when due. The first process does it for all."""
    fabric, solver = run.fabric, run.light_solver
    if fabric.is_global_zero:
        with doing("light_fits"):
            solver.observe(computed)
    if not fabric.broadcast(solver.due):
        return
    if fabric.is_global_zero:
        run.watch.after_fit(solver.points, step)
        with doing("light_fits", apart=True):
            found = solver.solve(model.brdf, model.scene)
        note_fit(run.fits, found, model.lamps.lit, step)
        _tell(run, after_fit(run.plan, found, model.lamps.lit, step + 1))
    _share_light(run, model)


def _share_light(run: Training, model: NeilfModel) -> None:
    """Let all processes have the light of the first."""
    if run.fabric.world_size > 1:
        for part in (model.light, model.lamps):
            part.load_state_dict(run.fabric.broadcast(part.state_dict()))


def _look(run: Training, model: NeilfModel, step: int) -> None:
    """What is looked at between two stages, where the next one learns a material."""
    if model.stages[stage_at(step, run.config.train).stage].moves_material:
        _look_at_effects(run, model, step)
        _start_light(run, model, step)


def _start_light(run: Training, model: NeilfModel, step: int) -> None:
    """Find the light that training starts with, before a material is learned. The first process does it for
    all.
    """
    if not run.light_solver.seeks_start:
        return
    decisions: list[Decision] = []
    if run.fabric.is_global_zero:
        seed_step(run.config.train.seed, -4 - step)
        decisions, found = look_at_light(run.plan, model, run.pixels, step, _light_pixels(run))
        _tell(run, decisions)
        if found is not None:
            run.reporter.say(found.in_words())
            start_with(model, found)
            measured = run.light_solver.start(found.observed, found.material, model.scene)
            note_fit(run.fits, measured, model.lamps.lit, step)
            _tell(run, after_fit(run.plan, measured, model.lamps.lit, step))
    _share_light(run, model)
    _share_decisions(run, model, decisions)


def _light_pixels(run: Training) -> int:
    """How many pixels the first light is found from at most; a budget may leave time for few or none."""
    most = None if run.pace is None else run.pace.plan.light_pixels
    return MOST_PIXELS if most is None else most


@doing("looks", apart=True)
def _look_at_quality(run: Training, model: NeilfModel, position: StagePosition, step: int) -> None:
    if run.fabric.is_global_zero:
        run.quality.look_when_due(model, position, step, run.ledger.total)


def _look_at_effects(run: Training, model: NeilfModel, step: int) -> None:
    """Let evidence decide the open effects from here on. The first process decides for all."""
    if not wants_surface(run.plan):
        return
    decisions: list[Decision] = []
    if run.fabric.is_global_zero:
        seed_step(run.config.train.seed, -3 - step)
        decisions = look_at_surface(run.plan, model, run.pixels, step)
        _tell(run, decisions)
    _share_decisions(run, model, decisions)


def _share_decisions(run: Training, model: NeilfModel, decisions: Sequence[Decision]) -> None:
    """Let all processes compute as the first has decided."""
    decisions = run.fabric.broadcast(decisions)
    if not run.fabric.is_global_zero:
        run.plan.decisions += decisions
    _use(run, model)


def _use(run: Training, model: NeilfModel) -> None:
    """Compute as the plan says; evidence may take the joint stage away."""
    config = run.plan.config
    if not config.train.joint_steps:
        run.config = dataclasses.replace(
            run.config, train=dataclasses.replace(run.config.train, joint_steps=0)
        )
    model.use(config)
    run.light_solver.use(config.light, model.lobe)


def _tell(run: Training, decisions: Sequence[Decision]) -> None:
    for decision in decisions:
        run.reporter.say(f"effects: {decision.effect} {'on' if decision.on else 'off'}, {decision.reason}")


@doing("optimiser")
def _update(
    run: Training,
    model: NeilfModel,
    optimizer: torch.optim.Optimizer,
    terms: LossTerms,
    total: Total,
    moment: Moment,
    step: int,
) -> bool:
    """One step down the gradient; a step whose loss or gradient is not finite is left out, counted and named.

    Returns whether a person has asked to stop.
    """
    optimizer.zero_grad(set_to_none=True)
    if total.loss.requires_grad:
        with doing("gradients"):
            run.fabric.backward(total.loss)
    norms = gradient_norms(model)
    psnr = _psnr(terms, run.model.units)
    stop = torch.full_like(psnr, run.should_stop())
    # The one transfer of the step: everything that the loop and the person must know. Every process takes the
    # mean over all of them, so that all leave out the same steps and all stop after the same one.
    known = run.fabric.all_reduce(torch.stack([total.loss.detach(), psnr, stop, *norms.values()])).tolist()
    loss, decibels, asked, found = known[0], known[1], known[2], dict(zip(norms, known[3:], strict=True))
    if all(math.isfinite(value) for value in (loss, *found.values())):
        optimizer.step()
        run.skipped_in_a_row = 0
    else:
        _skip(run, total, found, _kept(run, model, moment, step), step)
    run.reporter.step(loss, decibels)
    if step % LOG_EVERY == 0:
        _log(run, model, total, decibels, loss, step)
    return asked > 0.0


def _skip(run: Training, total: Total, norms: Mapping[str, float], kept: str, step: int) -> None:
    run.skipped += 1
    run.skipped_in_a_row += 1
    culprits = [name for name, value in total.terms.items() if not math.isfinite(value.item())]
    fields = [name for name, value in norms.items() if not math.isfinite(value)]
    where = (
        f"loss {', '.join(culprits)}"
        if culprits
        else f"the gradient of {', '.join(fields) or 'another process'}"
    )
    run.reporter.warn(f"step {step} skipped: {where} is not finite ({run.skipped} skipped so far){kept}")
    if run.skipped_in_a_row >= MAX_SKIPPED_IN_A_ROW:
        raise Diverged(
            f"{MAX_SKIPPED_IN_A_ROW} steps in a row were not finite, the last one in {where}",
            f"the last good checkpoint is kept in {run.path / 'checkpoints'}; look at the capture's "
            "brightest pixels or lower the learning rates",
        )


def _kept(run: Training, model: NeilfModel, moment: Moment, step: int) -> str:
    """Write down what is skipped, and say how it is looked into; a full disk is no reason to stop for it."""
    if not run.fabric.is_global_zero:
        return ""
    try:
        kept = keep_step(run.path, model, moment, step)
    except UserError as error:
        return f"; its rays are not kept: {error.problem}"
    return f"; see neilfpp replay {shlex.quote(str(run.path))} {step}" if kept else ""


def _psnr(terms: LossTerms, units: RadianceUnits) -> Tensor:
    """PSNR of the pixels that the stage compares, dB, in the capture's own response; NaN where there is none.

    The peak is 1, and errors are capped there: a few HDR highlights would else dominate the figure.
    """
    term, unit = (
        (terms["physical"], units.physical) if "physical" in terms else (terms["volume"], units.volume)
    )
    error = (term.values.detach() * unit).clamp_max(1.0).square().mean()
    return -10.0 * torch.log10(error.clamp_min(1e-10))


# ------------------------------------------------------------------------------------------- state and record


@doing("saving", apart=True)
def _save(run: Training, optimizer: torch.optim.Optimizer, step: int, also: str | None = None) -> None:
    if run.fabric.is_global_zero:
        try:
            # Fits first: extra ones are dropped on resume, gaps cannot be recovered.
            write_fits(run.path, run.fits)
            write_findings(run.path, run.watch)
            write_plan(run.path, run.plan)
            write_looks(run.path, run.quality)
            if run.pace is not None:
                run.pace.save(run.path, run.config.train)
            for name in filter(None, (also, "last")):
                save_checkpoint(
                    run.path / "checkpoints" / f"{name}.pt", run.model, run.light_solver, optimizer, step
                )
            write_json(run.path / "timing.json", run.seconds)
            write_work(run.path, run.ledger)
        except UserError as error:
            raise UserError(error.problem, f"make room, and continue with: {run.continue_with}") from error
    run.fabric.barrier()


def _restore(run: Training, optimizer: torch.optim.Optimizer) -> int:
    path = run.path / "checkpoints" / "last.pt"
    if not path.exists():
        return 0
    saved = load_checkpoint(path)
    load_weights(run.model, saved["model"], run.path)
    load_weights(run.light_solver, saved["light_solver"], run.path)
    optimizer.load_state_dict(saved["optimizer"])
    if (run.path / "timing.json").exists():
        run.seconds.update(read_json(run.path / "timing.json"))
    run.fits += read_fits(run.path, saved["step"])
    run.plan = read_plan(run.path, run.plan.settings, saved["step"])
    run.quality.looks += read_looks(run.path, saved["step"])
    _use(run, run.model)
    run.watch.findings |= {finding.case: finding for finding in read_findings(run.path) or ()}
    return saved["step"]


def _log(run: Training, model: NeilfModel, total: Total, decibels: float, loss: float, step: int) -> None:
    values = {"loss/total": loss, "psnr": decibels, "steps_skipped": float(run.skipped)}
    values |= {f"loss/{name}": value.item() for name, value in total.terms.items()}
    width = getattr(model.host, "surface_width", None)
    if width is not None:
        values["beta"] = width().item()
    if run.fits:
        values |= {
            f"light/{name}": float(getattr(run.fits[-1], name)) for name in ("gain", "deviation", "lamps")
        }
    run.reporter.scalars(step, values)
