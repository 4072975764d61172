"""`neilfpp train`: train a run from a capture."""

from __future__ import annotations

import shutil
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from dataclasses import replace
from pathlib import Path

import torch
from lightning_fabric import Fabric
from rich.console import Console
from torch import Tensor

from neilfpp_method.budget.durations import format_duration
from neilfpp_method.data.capture import Capture
from neilfpp_method.data.environment_map import check_environment
from neilfpp_method.data.held_back import PATCHES, hold_back
from neilfpp_method.data.pixels import PixelDataset
from neilfpp_method.data.scaling import at_scale, scale_for_rays
from neilfpp_method.effects.plan import Plan
from neilfpp_method.effects.request import EffectRequest, check_effects
from neilfpp_method.effects.review import record_exposures, record_facts
from neilfpp_method.effects.table import table
from neilfpp_method.errors import Unsound, UserError
from neilfpp_method.health.cases import verdict_of
from neilfpp_method.health.watch import CHECKED_PIXELS, Watch
from neilfpp_method.inspection.findings import problems_of_poses
from neilfpp_method.model import NeilfModel
from neilfpp_method.schedule import Stage, stage_steps
from neilfpp_method.settings.check import check_config
from neilfpp_method.settings.types import NeilfConfig
from neilfpp_method.timing.ledger import Ledger, recording
from neilfpp_method.train.budget_record import read_budget, write_budget
from neilfpp_method.train.budgeted import (
    close_budget,
    outcome,
    plan_budget,
    planned_effects,
    planned_settings,
)
from neilfpp_method.train.build import (
    build_model,
    cloud_summary,
    exposures_of,
    scene_facts,
    show_known_light,
)
from neilfpp_method.train.device import pick_device
from neilfpp_method.train.effects_record import read_plan, write_plan
from neilfpp_method.train.health_record import health_summary
from neilfpp_method.train.launch import launch
from neilfpp_method.train.light_record import light_summary
from neilfpp_method.train.lock import run_lock
from neilfpp_method.train.loop import train
from neilfpp_method.train.memory import check_training_memory
from neilfpp_method.train.optimizer import seed_step
from neilfpp_method.train.output import default_folder
from neilfpp_method.train.pace import Pace
from neilfpp_method.train.preview import write_preview
from neilfpp_method.train.progress import Reporter, reporting
from neilfpp_method.train.quality import Quality, has_checks
from neilfpp_method.train.reading import load_pixels
from neilfpp_method.train.run import (
    PIXELS,
    CaptureSource,
    Description,
    check_free,
    create_run,
    load_checkpoint,
    read_description,
)
from neilfpp_method.train.start import start_geometry
from neilfpp_method.train.stopping import continue_command, stop_request
from neilfpp_method.train.training import Training
from neilfpp_method.train.work_record import read_work, waiting, write_work

__all__ = ["run_training"]


def run_training(
    *,
    data: Path | None,
    out: Path | None,
    config: NeilfConfig | None,
    resume: bool,
    test_every: int | None,
    response: str,
    device: str,
    devices: int,
    console: Console,
    nodes: int = 1,
    format: str | None = None,
    scale: float | None = None,
    strict: bool = False,
    effects: EffectRequest | None = None,
    budget: float | None = None,
    command: str = "neilfpp train",
    at_end: Callable[[Path], None] | None = None,
) -> Path:
    """Train a run to its end. A run that is finished already is left unchanged.

    Args:
        data: folder of the capture; required unless `resume`.
        out: the run folder; None for `runs/CAPTURE-PRESET`. Required with `resume`.
        config: the settings; None, with `resume`, for those of the run.
        resume: whether to continue an existing run.
        test_every: every how many views one is held out, if the capture does not say; None for the default.
        response: what pixels hold: "linear", "srgb", or "auto" for what the files say.
        device: name of the device (`train.device`).
        devices: number of processes on this machine, each with a GPU of its own if the device is "cuda".
        nodes: number of machines, each with `devices` processes that torchrun has started.
        console: where progress is printed.
        format: format of the capture; None to recognise it from the files.
        scale: size of the images relative to their files; None for the largest that the rays of the training
            can use.
        strict: whether to raise `Unsound` if the result is unusable.
        effects: the value of `--effects` (`effects.request`); None for the effects of the settings or, with
            `resume`, of the run.
        budget: time of everything from here to the end of `at_end`, in seconds; None to train as many steps
            as the settings say or, with `resume`, to keep the budget of the run.
        command: beginning of the command line that continues a stopped run, for messages.
        at_end: called in the first process with the folder of the finished run, even if its health is bad.

    Returns:
        The run folder.

    Raises:
        UserError: if the input is unusable; no run folder is left behind.
        Stopped: if the user stops the training; the message names the command that continues it.
        Diverged: see `train.loop.train`.
        Unsound: with `strict`, if a finding is severe; the run is kept.
    """
    torch_device = pick_device(device)
    ledger = Ledger(synchronise=waiting(torch_device))
    # Errors that the settings and file headers reveal are raised before other processes start.
    if resume:
        if out is None:
            raise UserError("--resume needs the run's folder", "give it with --out RUN")
        described = read_description(out)
        _refuse_changes(out, described, data, config, test_every, response, format, scale)
        plan, source = read_plan(out, described.config), described.source
        if effects not in (None, plan.request):
            raise UserError(
                f"{out}: its effects are '{plan.request}'", "leave --effects out, or start a new run"
            )
        config, planned = plan.config_of_model, read_budget(out)
        if budget not in (None, planned and planned.budget):
            has = "no budget" if planned is None else f"a budget of {format_duration(planned.budget)}"
            raise UserError(f"{out}: the run has {has}", "leave --budget out, or start a new run")
        ledger.add(read_work(out))
        if _is_finished(out, plan.config):
            # The command was stopped while it wrote the report.
            if planned is not None and planned.took is None:
                close_budget(out, planned, ledger.total)
            console.print(f"run folder {out}: finished already, nothing to continue", soft_wrap=True)
            return out
    else:
        if data is None or config is None:
            raise UserError("no capture given", "name its folder with --data DIR")
        request = effects or EffectRequest("as-set")
        check_effects(request, config)
        _check(Plan.begin(request, config).config)
        source = CaptureSource(str(data.resolve()), test_every, response, format)
        check_free(out := out or default_folder(data, config))
    capture = source.load_again(out) if resume else source.load()
    if not resume:
        planned = None
        if budget is not None:
            with_report = at_end is not None
            planned = plan_budget(
                budget,
                capture,
                config,
                request,
                torch_device,
                devices * nodes,
                ledger,
                with_report,
                console.print,
            )
            config = planned_settings(planned, config)
        settings, plan = config, Plan.begin(request, config)
        if planned is not None:
            planned_effects(planned, plan)
        config = plan.config
        rays = config.train.rays * devices * nodes * sum(stage_steps(config.train).values())
        source = replace(source, scale=scale_for_rays(capture.train_views, rays) if scale is None else scale)
        capture = at_scale(capture, source.scale)
    check_training_memory(capture)
    fabric = launch(torch_device, devices, nodes)
    with recording(ledger), _removed_on_failure(out), run_lock(out):
        pixels = load_pixels(capture, out / PIXELS, fabric, console)
        if resume:
            facts = described.facts
        else:
            gains = _log_gains(plan, capture, pixels)
            facts = scene_facts(capture, pixels, config, gains)
        record_facts(plan, facts)
        config = plan.config_of_model
        seed_step(config.train.seed, step=-1)
        model = build_model(capture, facts, config)
        is_new = not (out / "checkpoints" / "last.pt").exists()
        if is_new:
            show_known_light(model)
        if fabric.is_global_zero:
            if not resume:
                create_run(out, settings, source, facts)
                write_plan(out, plan)
                if planned is not None:
                    write_budget(out, planned)
            console.print(capture.summary, soft_wrap=True)
            if not resume:
                for line in problems_of_poses(capture):
                    console.print(line, style="yellow", soft_wrap=True, markup=False)
                if source.scale < 1:
                    console.print(_scaled(source.scale, len(pixels), rays), soft_wrap=True)
                for line in (cloud_summary(capture, config), _exposures_summary(plan)):
                    if line is not None:
                        console.print(line, soft_wrap=True)
            console.print(f"run folder {out}", soft_wrap=True)
        # Every process computes the same initial geometry.
        start = start_geometry(model, capture, config) if is_new else None
        if start and fabric.is_global_zero:
            console.print(start.text, style="yellow" if start.warning else None, soft_wrap=True)
    fabric.barrier()
    continue_with = continue_command(command, out, device, devices, nodes)
    with (
        run_lock(out),
        recording(ledger),
        reporting(out, console, fabric.is_global_zero) as reporter,
        stop_request(continue_with) as stopped,
    ):
        # A run that began without held-back pixels, in nerfstudio, continues to train on all pixels.
        held_back = hold_back(pixels, config.train.seed, PATCHES if is_new or has_checks(out) else 0)
        preview = _preview(out, capture, fabric, reporter)
        solver, watch = model.light_solver(), _watch(pixels, config, reporter)
        training = Training(
            path=out,
            config=config,
            model=model,
            pixels=pixels,
            fabric=fabric,
            reporter=reporter,
            should_stop=stopped,
            preview=preview,
            continue_with=continue_with,
            light_solver=solver,
            watch=watch,
            plan=plan,
            quality=Quality(held_back, capture.hdr),
            ledger=ledger,
            pace=None if planned is None else Pace(planned, ledger),
        )
        train(training)
    if fabric.is_global_zero:
        # Written once more, to include the time of the last checkpoint and preview.
        write_work(out, ledger)
    if fabric.is_global_zero and training.fits:
        console.print(f"light: {light_summary(config.light, training.fits)}", soft_wrap=True)
    if fabric.is_global_zero and training.plan.request.base != "as-set":
        console.print(table(training.plan))
    findings = list(watch.findings.values())
    if fabric.is_global_zero:
        console.print(f"health: {health_summary(findings)}", soft_wrap=True, markup=False)
        if at_end is not None:
            at_end(out)
    if fabric.is_global_zero and planned is not None:
        close_budget(out, planned, ledger.total)
        console.print(outcome(planned, training.quality.checks), soft_wrap=True)
    if strict and verdict_of(findings) == "failed":
        raise Unsound(f"{out}: {findings[0].what}", findings[0].remedy)
    return out


def _log_gains(plan: Plan, capture: Capture, pixels: PixelDataset) -> Tensor | None:
    """Initial log gains of the photographs, after the decision whether photographs have gains.

    Returns None if they have none, and zeros if they are requested but cannot be measured.
    """
    if not plan.is_on("exposure"):
        return None
    exposures = exposures_of(capture, pixels)
    record_exposures(plan, exposures)
    if not plan.is_on("exposure"):
        return None
    return torch.zeros(len(pixels.views), 3) if exposures is None else exposures.log_gain


def _exposures_summary(plan: Plan) -> str | None:
    """One line that photographs have gains, with the reason; None if they have none."""
    decision = plan.newest("exposure")
    return f"effects: exposure on, {decision.reason}" if decision is not None and decision.on else None


def _watch(pixels: PixelDataset, config: NeilfConfig, reporter: Reporter) -> Watch:
    seed_step(config.train.seed, step=-2)
    return Watch(pixels.sample(CHECKED_PIXELS, gradients=False), reporter.warn)


def _refuse_changes(
    out: Path,
    described: Description,
    data: Path | None,
    config: NeilfConfig | None,
    test_every: int | None,
    response: str,
    format: str | None,
    scale: float | None,
) -> None:
    """Raise a `UserError` if an option given together with --resume differs from that of the run."""
    source = described.source
    given = CaptureSource(
        source.root if data is None else str(data.resolve()),
        source.test_every if test_every is None else test_every,
        source.response if response == "auto" else response,
        format or source.format,
        source.scale if scale is None else scale,
    )
    if given != source or config not in (None, described.config):
        raise UserError(
            f"{out}: a run keeps its capture and its settings, and --resume was given with different ones",
            "leave these options out, or start a new run in another --out",
        )


def _is_finished(out: Path, config: NeilfConfig) -> bool:
    last = out / "checkpoints" / "last.pt"
    return last.exists() and load_checkpoint(last)["step"] >= sum(stage_steps(config.train).values())


def _check(config: NeilfConfig) -> None:
    """Check the settings of a new run.

    Raises:
        UserError: if a setting is out of range, or the known map is unusable.
    """
    if min(stage_steps(config.train).values()) < 0 or sum(stage_steps(config.train).values()) == 0:
        raise UserError(
            "the stages have no steps", "set --config.train.sdf-steps and the others to 0 or more"
        )
    check_config(config)
    if config.known_map is not None:
        check_environment(Path(config.known_map))
    if config.train.sdf_steps and config.loss.volume <= 0.0:
        raise UserError("--config.loss.volume is 0, so R is not compared with the images", "set it above 0")


def _scaled(scale: float, pixels: int, rays: int) -> str:
    return (
        f"images scaled to {scale:.3g} of their size: {pixels / 1e6:.1f} million pixels for "
        f"{rays / 1e6:.1f} million rays; --scale 1 uses the full size"
    )


@contextmanager
def _removed_on_failure(out: Path) -> Iterator[None]:
    """If the context fails before the run exists, remove all folders that were created for it."""
    created = [folder for folder in (out, *out.parents) if not folder.exists()]
    try:
        yield
    except BaseException:
        if not (out / "config.json").exists():
            shutil.rmtree(out / PIXELS, ignore_errors=True)
            with suppress(OSError):
                for folder in created:
                    folder.rmdir()
        raise


def _preview(
    out: Path, capture: Capture, fabric: Fabric, reporter: Reporter
) -> Callable[[NeilfModel, Stage], None]:
    def preview(model: NeilfModel, stage: Stage) -> None:
        if fabric.is_global_zero:
            pixels = write_preview(model, capture, stage, out / "previews" / f"{stage.value}.png")
            reporter.picture(0, f"preview/{stage.value}", pixels)

    return preview
