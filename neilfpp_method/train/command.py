"""`neilfpp train`: train a run from a capture."""

from __future__ import annotations

import shutil
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from pathlib import Path

from lightning_fabric import Fabric
from rich.console import Console

from neilfpp_method.data.capture import Capture
from neilfpp_method.data.pixels.dataset import PixelDataset
from neilfpp_method.data.pixels.held_back import PATCHES, hold_back
from neilfpp_method.data.pixels.object_source import object_line, object_sources, stored_masks
from neilfpp_method.effects.plan import Plan
from neilfpp_method.effects.review import record_facts
from neilfpp_method.effects.table import effects_table
from neilfpp_method.errors import Unsound
from neilfpp_method.health.watch import CHECKED_PIXELS, Watch
from neilfpp_method.hosts.mesh import MeshHost
from neilfpp_method.inspection.defects import problems_of_masks, problems_of_poses
from neilfpp_method.model import NeilfModel
from neilfpp_method.schedule import Stage
from neilfpp_method.settings.facts import SceneFacts
from neilfpp_method.settings.types import NeilfConfig
from neilfpp_method.timing.ledger import Ledger, recording
from neilfpp_method.train.budget_record import write_budget
from neilfpp_method.train.budgeted import close_budget, outcome
from neilfpp_method.train.build import (
    build_model,
    cloud_summary,
    initial_model,
    measure_facts,
)
from neilfpp_method.train.checkpoint import last_checkpoint
from neilfpp_method.train.device import pick_device, waiting
from neilfpp_method.train.effects_record import write_plan
from neilfpp_method.train.launch import launch
from neilfpp_method.train.light_record import light_summary
from neilfpp_method.train.lock import run_lock
from neilfpp_method.train.loop import train
from neilfpp_method.train.memory import check_training_memory
from neilfpp_method.train.mesh_fit import measure_mesh_fit
from neilfpp_method.train.opening import OpenRun, open_run, plan_run, training_rays
from neilfpp_method.train.optimizer import Stream, seed_stream
from neilfpp_method.train.pace import Pace
from neilfpp_method.train.preview import write_preview
from neilfpp_method.train.progress import Reporter, reporting
from neilfpp_method.train.quality import Quality, has_checks
from neilfpp_method.train.reading import load_training_pixels
from neilfpp_method.train.request import TrainingRequest
from neilfpp_method.train.run import PIXELS, create_run
from neilfpp_method.train.start import start_geometry
from neilfpp_method.train.stopping import continue_command, stop_request
from neilfpp_method.train.training import Training
from neilfpp_method.train.work_record import write_work

__all__ = ["run_training"]


def run_training(
    request: TrainingRequest, console: Console, at_end: Callable[[Path], None] | None = None
) -> Path:
    """Train a run to its end. A run that is finished already is left unchanged.

    Args:
        request: the capture or the run, the settings and the machine.
        console: where progress is printed.
        at_end: called in the first process with the folder of the finished run, even if its health is bad.

    Returns:
        The run folder.

    Raises:
        UserError: if the input is unusable; no run folder is left behind.
        Stopped: if the user stops the training; the message names the command that continues it.
        Diverged: see `train.loop.train`.
        Unsound: with `request.strict`, if a finding is severe; the run is kept.

    Example:
        >>> request = TrainingRequest(data=Path("captures/teapot"), config=preset("fast"))  # doctest: +SKIP
        >>> run = load_run(run_training(request, Console()))                                # doctest: +SKIP
    """
    device = pick_device(request.device)
    ledger = Ledger(synchronize=waiting(device))
    if request.resume:
        run = open_run(request, ledger)
        if run is None:
            console.print(f"run folder {request.out}: finished already, nothing to continue", soft_wrap=True)
            return request.out
    else:
        run = plan_run(request, device, ledger, at_end is not None, console)
    check_training_memory(run.capture)
    fabric = launch(device, request.devices, request.nodes)
    console = console if fabric.is_global_zero else Console(quiet=True)
    with recording(ledger):
        with _removed_on_failure(run.out), run_lock(run.out):
            prepared = _prepare(run, fabric, console)
        fabric.barrier()
        with run_lock(run.out):
            training = _train(request, run, prepared, ledger, console)
    if fabric.is_global_zero:
        _finish(run, training, console, at_end)
    failure = training.watch.health.failure
    if request.strict and failure is not None:
        raise Unsound(f"{run.out}: {failure.what}", failure.remedy)
    return run.out


# ---------------------------------------------------------------------------------------- before the training


@dataclass(frozen=True)
class _Prepared:
    """What the training of a run begins with in this process.

    Attributes:
        fabric: device and processes.
        pixels: the training pixels.
        config: the settings from which the model is built.
        model: the model; its weights are those of the start, even if the run has a checkpoint.
        untrained: whether the run has no checkpoint.
    """

    fabric: Fabric
    pixels: PixelDataset
    config: NeilfConfig
    model: NeilfModel
    untrained: bool


def _prepare(run: OpenRun, fabric: Fabric, console: Console) -> _Prepared:
    """Read the pixels, build the model, and create the folder of a new run."""
    pixels = load_training_pixels(run.capture, run.out / PIXELS, fabric, console)
    facts = measure_facts(run.plan, run.capture, pixels) if run.facts is None else run.facts
    record_facts(run.plan, facts)
    config = run.plan.config_of_model
    untrained = not last_checkpoint(run.out).exists()
    build = initial_model if untrained else build_model
    model = build(run.capture, facts, config)
    if run.is_new and fabric.is_global_zero:
        _create(run, facts)
    console.print(run.capture.summary, soft_wrap=True)
    if run.is_new and fabric.is_global_zero:
        _describe_new(run, model, pixels, fabric.world_size, console)
    console.print(f"run folder {run.out}", soft_wrap=True)
    # Every process computes the same initial geometry.
    start = start_geometry(model, run.capture, config) if untrained else None
    if start:
        console.print(start.text, style="yellow" if start.warning else None, soft_wrap=True)
    return _Prepared(fabric, pixels, config, model, untrained)


def _create(run: OpenRun, facts: SceneFacts) -> None:
    """Write the description of a new run into its folder."""
    create_run(run.out, run.plan.settings, run.source, facts)
    write_plan(run.out, run.plan)
    if run.budget is not None:
        write_budget(run.out, run.budget)


def _describe_new(
    run: OpenRun, model: NeilfModel, pixels: PixelDataset, processes: int, console: Console
) -> None:
    """Print what shows the object, problems of masks, poses and a given mesh, and how images, point cloud and
    exposures are used.
    """
    console.print(object_line(object_sources(pixels.store)), soft_wrap=True)
    for line in (*problems_of_masks(stored_masks(pixels.store)), *problems_of_poses(run.capture)):
        console.print(line, style="yellow", soft_wrap=True, markup=False)
    if isinstance(model.host, MeshHost) and (warning := measure_mesh_fit(model.host, pixels).warning):
        console.print(warning, style="yellow", soft_wrap=True)
    if run.source.scale < 1:
        rays = training_rays(run.plan.config.train, processes)
        console.print(_scale_summary(run.source.scale, len(pixels), rays), soft_wrap=True)
    for line in (cloud_summary(run.capture, model.config), _exposures_summary(run.plan)):
        if line is not None:
            console.print(line, soft_wrap=True)


def _scale_summary(scale: float, pixels: int, rays: int) -> str:
    return (
        f"images scaled to {scale:.3g} of their size: {_rounded(pixels)} pixels for "
        f"{_rounded(rays)} rays; --scale 1 uses the full size"
    )


def _rounded(count: int) -> str:
    """A large number in words; thousands below a million.

    >>> _rounded(2_345_678), _rounded(45_678)
    ('2.3 million', '46 thousand')
    """
    return f"{count / 1e6:.1f} million" if count >= 1e6 else f"{count / 1e3:.0f} thousand"


def _exposures_summary(plan: Plan) -> str | None:
    """One line that photographs have gains, with the reason; None if they have none."""
    decision = plan.newest("exposure")
    return f"effects: exposure on, {decision.reason}" if decision is not None and decision.on else None


@contextmanager
def _removed_on_failure(out: Path) -> Iterator[None]:
    """If the context fails before the run exists, remove all folders that were created for it."""
    created = [folder for folder in (out, *out.parents) if not folder.exists()]
    try:
        yield
    except BaseException:
        if not (out / "config.json").exists():
            _remove(out, created)
        raise


def _remove(out: Path, created: Sequence[Path]) -> None:
    """Remove the pixels of a run that does not exist yet, and those of the created folders that are empty."""
    shutil.rmtree(out / PIXELS, ignore_errors=True)
    with suppress(OSError):
        for folder in created:
            folder.rmdir()


# --------------------------------------------------------------------------------------- training and its end


def _train(
    request: TrainingRequest, run: OpenRun, prepared: _Prepared, ledger: Ledger, console: Console
) -> Training:
    """Train the remaining steps. Returns the final state of the training."""
    fabric, pixels, config = prepared.fabric, prepared.pixels, prepared.config
    # A run that began without held-back pixels, in nerfstudio, continues to train on all pixels.
    patches = PATCHES if prepared.untrained or has_checks(run.out) else 0
    continue_with = continue_command(request, run.out)
    with (
        reporting(run.out, console, fabric.is_global_zero) as reporter,
        stop_request(continue_with) as stopped,
    ):
        held_back = hold_back(pixels, config.train.seed, patches)
        training = Training(
            path=run.out,
            config=config,
            model=prepared.model,
            pixels=pixels,
            fabric=fabric,
            reporter=reporter,
            should_stop=stopped,
            preview=_preview(run.out, fabric, reporter),
            continue_with=continue_with,
            light_solver=prepared.model.light_solver(),
            watch=_watch(pixels, config, reporter),
            plan=run.plan,
            quality=Quality(held_back),
            ledger=ledger,
            pace=None if run.budget is None else Pace(run.budget, ledger),
        )
        train(training)
    return training


def _watch(pixels: PixelDataset, config: NeilfConfig, reporter: Reporter) -> Watch:
    seed_stream(config.train.seed, Stream.HEALTH)
    return Watch(pixels.sample(CHECKED_PIXELS, gradients=False), reporter.warn, reporter.say)


def _preview(out: Path, fabric: Fabric, reporter: Reporter) -> Callable[[NeilfModel, Capture, Stage], None]:
    def preview(model: NeilfModel, capture: Capture, stage: Stage) -> None:
        if fabric.is_global_zero:
            pixels = write_preview(model, capture, stage, out / "previews" / f"{stage.value}.png")
            reporter.picture(0, f"preview/{stage.value}", pixels)

    return preview


def _finish(
    run: OpenRun, training: Training, console: Console, at_end: Callable[[Path], None] | None
) -> None:
    """Print the results, call `at_end`, and record the time that the run has taken."""
    # Written once more, to include the time of the last checkpoint and preview.
    write_work(run.out, training.ledger)
    if training.fits:
        console.print(f"light: {light_summary(training.config.light, training.fits)}", soft_wrap=True)
    if training.plan.request.base != "as-set":
        console.print(effects_table(training.plan))
    console.print(f"health: {training.watch.health}", soft_wrap=True, markup=False)
    if at_end is not None:
        at_end(run.out)
    if run.budget is not None:
        close_budget(run.out, run.budget, training.ledger.total)
        console.print(outcome(run.budget, training.quality.checks), soft_wrap=True)
