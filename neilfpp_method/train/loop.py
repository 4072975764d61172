"""The training loop: up to three stages with one optimizer.

The random numbers of a step depend only on the seed and the step number, so a resumed run continues exactly
as an uninterrupted one.
"""

from __future__ import annotations

import dataclasses
import math
import time
from collections.abc import Callable, Mapping, Sequence

import torch
from torch import Tensor

from neilfpp_method.data.files.json_entry import write_json
from neilfpp_method.errors import Diverged, Stopped, UserError
from neilfpp_method.health.guard import MAX_SKIPPED_IN_A_ROW
from neilfpp_method.hosts.base import HasSurfaceWidth
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
from neilfpp_method.structures import LossTerms, PixelBatch, StepResult
from neilfpp_method.timing.ledger import timed
from neilfpp_method.train.checkpoint import (
    LAST,
    checkpoint_path,
    last_checkpoint,
    load_checkpoint,
    load_weights,
    save_checkpoint,
)
from neilfpp_method.train.effects_record import read_plan, write_plan
from neilfpp_method.train.evidence import (
    apply_plan,
    apply_poses,
    correct_final_scale,
    fit_poses,
    improve_half_trained,
    observe_and_solve,
    review_before_stage,
)
from neilfpp_method.train.health_record import read_findings, write_findings
from neilfpp_method.train.json_files import read_json
from neilfpp_method.train.light_record import read_fits, write_fits
from neilfpp_method.train.optimizer import (
    gradient_norms,
    limit_surface_width,
    make_optimizer,
    seed_step,
    set_rates,
    waiting_fields,
)
from neilfpp_method.train.patches import show_patches
from neilfpp_method.train.quality import read_checks, write_checks
from neilfpp_method.train.skipped import Moment, keep_with_note
from neilfpp_method.train.training import Training
from neilfpp_method.train.vanished import restore_surface
from neilfpp_method.train.work_record import write_work

__all__ = ["train"]

LOG_EVERY = 50
"""Steps between two entries in the TensorBoard log. The longest preset then has about a thousand."""


def train(run: Training) -> None:
    """Train to the end, from the last checkpoint if there is one.

    Raises:
        Stopped: if `run.should_stop` returns True. The state is saved, and continuing from it gives the same
            result as not stopping.
        Diverged: if ten steps in a row are not finite; the last good checkpoint is kept.
    """
    model = run.model.to(run.fabric.device).train()
    run.light_solver.to(run.fabric.device)
    optimizer = make_optimizer(model, run.config.optimizer)
    step = _restore(run, optimizer)
    optimizer = run.fabric.setup_optimizers(optimizer)
    if step == 0:
        review_before_stage(run, step)
    while step < total_steps(run.config.train):
        position = stage_at(step, run.config.train)
        show_patches(run.model, run.pixels, position.stage)
        step = _train_stage(run, optimizer, position, step)
        if run.fabric.is_global_zero:
            with timed("checks", undivided=True):
                run.watch.after_stage(model, model.stages[position.stage], run.skipped, step)
        with timed("checks", undivided=True):
            if step < total_steps(run.config.train):
                review_before_stage(run, step)
            # The review may leave out the joint stage.
            if step == total_steps(run.config.train):
                correct_final_scale(run, step)
        _save(run, optimizer, step, names=(position.stage.value, LAST))
        with timed("checks", undivided=True):
            model.eval()
            run.preview(model, run.pixels.capture, position.stage)
            model.train()


def _train_stage(run: Training, optimizer: torch.optim.Optimizer, position: StagePosition, step: int) -> int:
    """Train the remaining steps of a stage. Returns the number of steps trained so far in all stages."""
    model, stage = run.model, position.stage
    model.freeze_for(stage)
    # A data-parallel wrapper is made for each stage, because it fixes the set of trained parameters.
    wrapped = run.fabric.setup_module(model, move_to_device=False)
    run.ledger.enter(stage.value)
    run.reporter.begin_stage(stage.value, position.step, position.length)
    started = time.perf_counter()
    before = run.seconds.get(stage.value, 0.0)
    number, length = position.step, position.length
    while number < length:
        at = StagePosition(stage, number, length)
        stop = _train_step(run, optimizer, wrapped, at, step)
        number, step = number + 1, step + 1
        length = _keep_pace(run, StagePosition(stage, number, length), step)
        reached = StagePosition(stage, number, length)
        if restore_surface(model.host, reached):
            run.reporter.say(f"step {step}: the surface had vanished and is restored")
        fit_poses(run, reached, step)
        improve_half_trained(run, reached, step)
        _check_quality(run, reached, step)
        run.seconds[stage.value] = before + time.perf_counter() - started
        if number == length:
            # `train` saves the end of a stage under its name, and a stop takes effect after that.
            break
        if stop or step % run.config.train.checkpoint_every == 0:
            _save(run, optimizer, step)
        if stop:
            raise Stopped(f"stopped after step {step}", f"continue with: {run.continue_with}")
    return step


def _train_step(
    run: Training,
    optimizer: torch.optim.Optimizer,
    wrapped: Callable[[PixelBatch, Stage], StepResult],
    at: StagePosition,
    step: int,
) -> bool:
    """Train one step, and fit the light if that is due.

    Args:
        run: the training.
        optimizer: the optimizer of all fields.
        wrapped: `NeilfModel.step`, by the data-parallel wrapper of the stage.
        at: the stage, and the index of the step in it.
        step: index of the step in all stages.

    Returns:
        Whether a stop has been requested.
    """
    model, settings = run.model, run.config.train
    with run.ledger.step(at.step):
        seed_step(settings.seed, step, run.fabric.global_rank)
        waiting = waiting_fields(model, run.config.optimizer, at)
        set_rates(optimizer, run.config.optimizer, at, waiting)
        weights = active_losses(at.stage, model.config, model.stages, at.share)
        with timed("data"):
            # Only the smoothness loss reads image gradients.
            batch = run.pixels.sample(settings.rays, gradients="smoothness" in weights)
        moment = Moment.before_step(batch, at, step)
        computed = wrapped(batch, at.stage)
        total = weigh(computed.terms, weights)
        stop = _update(run, optimizer, computed.terms, total, moment)
        observe_and_solve(run, computed, step)
    run.watch.after_step(model.stages[at.stage], computed, step)
    return stop


def _keep_pace(run: Training, position: StagePosition, step: int) -> int:
    """Adapt the number of steps to the budget if there is one. Returns the length of the stage."""
    if run.pace is None:
        return position.length
    revised = run.pace.revise(run.config.train, position, step)
    if revised is not run.config.train:
        run.config = dataclasses.replace(run.config, train=revised)
        run.reporter.lengthen(stage_steps(revised)[position.stage])
    return stage_steps(revised)[position.stage]


@timed("checks", undivided=True)
def _check_quality(run: Training, position: StagePosition, step: int) -> None:
    if run.fabric.is_global_zero:
        held_back = run.quality.check_when_due(run.model, position, step, run.ledger.total)
        if held_back is not None:
            run.watch.after_check(run.model, position, held_back, step)


@timed("optimizer")
def _update(
    run: Training, optimizer: torch.optim.Optimizer, terms: LossTerms, total: Total, moment: Moment
) -> bool:
    """Take an optimizer step. A step whose loss or gradient is not finite is skipped and reported.

    Returns whether a stop has been requested.
    """
    optimizer.zero_grad(set_to_none=True)
    if total.loss.requires_grad:
        with timed("gradients"):
            run.fabric.backward(total.loss)
    norms = gradient_norms(run.model)
    psnr = _psnr(terms, run.model.units)
    stop = torch.full_like(psnr, run.should_stop())
    # The only transfer from the device in a step. All processes use the mean over the processes, so that they
    # skip the same steps and stop after the same step.
    means = run.fabric.all_reduce(torch.stack([total.loss.detach(), psnr, stop, *norms.values()])).tolist()
    loss, decibels, stopping, *mean_norms = means
    if all(math.isfinite(value) for value in (loss, *mean_norms)):
        optimizer.step()
        limit_surface_width(run.model.host, run.config, moment.position)
        run.skipped_in_a_row = 0
    else:
        _skip(run, total, dict(zip(norms, mean_norms, strict=True)), moment)
    run.reporter.step(loss, decibels)
    if moment.step % LOG_EVERY == 0:
        _log(run, total, decibels, loss, moment.step)
    return stopping > 0.0


def _skip(run: Training, total: Total, norms: Mapping[str, float], moment: Moment) -> None:
    """Count, store and report a skipped step; raise `Diverged` after too many in a row."""
    kept = keep_with_note(run.path, run.model, moment) if run.fabric.is_global_zero else ""
    run.skipped += 1
    run.skipped_in_a_row += 1
    culprits = [name for name, value in total.terms.items() if not math.isfinite(value.item())]
    fields = [name for name, value in norms.items() if not math.isfinite(value)]
    where = (
        f"loss {', '.join(culprits)}"
        if culprits
        else f"the gradient of {', '.join(fields) or 'another process'}"
    )
    run.reporter.warn(
        f"step {moment.step} skipped: {where} is not finite ({run.skipped} skipped so far){kept}"
    )
    if run.skipped_in_a_row >= MAX_SKIPPED_IN_A_ROW:
        raise Diverged(
            f"{MAX_SKIPPED_IN_A_ROW} steps in a row were not finite, the last one in {where}",
            f"the last good checkpoint is kept in {last_checkpoint(run.path).parent}; look at the capture's "
            "brightest pixels or lower the learning rates",
        )


def _psnr(terms: LossTerms, units: RadianceUnits) -> Tensor:
    """PSNR of the pixels of a step in dB, in the response of the capture; NaN if it has none.

    The peak is 1. Errors are clipped at 1, because a few HDR highlights would otherwise dominate.
    """
    term, unit = (
        (terms["physical"], units.physical) if "physical" in terms else (terms["volume"], units.volume)
    )
    error = (term.values.detach() * unit).clamp_max(1.0).square().mean()
    return -10.0 * torch.log10(error.clamp_min(1e-10))


# ------------------------------------------------------------------------------------------- state and record


@timed("saving", undivided=True)
def _save(run: Training, optimizer: torch.optim.Optimizer, step: int, names: Sequence[str] = (LAST,)) -> None:
    """Write the records of the run, and its state as checkpoints of these names."""
    if run.fabric.is_global_zero:
        try:
            # The records are written before the checkpoint: when the run is resumed, entries after the
            # checkpoint are dropped, whereas missing ones could not be recovered.
            write_fits(run.path, run.fits)
            write_findings(run.path, run.watch)
            write_plan(run.path, run.plan)
            write_checks(run.path, run.quality)
            if run.pace is not None:
                run.pace.save(run.path, run.config.train)
            for name in names:
                save_checkpoint(checkpoint_path(run.path, name), run.model, run.light_solver, optimizer, step)
            write_json(run.path / "timing.json", run.seconds)
            write_work(run.path, run.ledger)
        except UserError as error:
            raise UserError(error.problem, f"make room, and continue with: {run.continue_with}") from error
    run.fabric.barrier()


def _restore(run: Training, optimizer: torch.optim.Optimizer) -> int:
    path = last_checkpoint(run.path)
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
    run.quality.checks += read_checks(run.path, saved["step"])
    apply_plan(run)
    apply_poses(run)
    run.watch.findings |= {finding.case: finding for finding in read_findings(run.path) or ()}
    return saved["step"]


def _log(run: Training, total: Total, decibels: float, loss: float, step: int) -> None:
    values = {"loss/total": loss, "psnr": decibels, "steps_skipped": float(run.skipped)}
    values |= {f"loss/{name}": value.item() for name, value in total.terms.items()}
    if isinstance(run.model.host, HasSurfaceWidth):
        values["beta"] = run.model.host.surface_width().item()
    if run.fits:
        values |= {
            f"light/{name}": float(getattr(run.fits[-1], name)) for name in ("gain", "deviation", "lamps")
        }
    run.reporter.scalars(step, values)
