"""Begin a training: read an existing run folder to continue it, or plan a new run.

Both happen before other processes start and before any image is decoded, so that errors in the options, the
settings and the file headers are reported at once.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path

import torch
from rich.console import Console

from neilfpp_method.budget.durations import format_duration
from neilfpp_method.data.capture import Capture
from neilfpp_method.data.files.environment_map import check_environment
from neilfpp_method.data.scaling import at_scale, scale_for_rays
from neilfpp_method.effects.plan import Plan
from neilfpp_method.effects.request import EffectRequest, check_effects
from neilfpp_method.errors import UserError
from neilfpp_method.schedule import stage_steps, total_steps
from neilfpp_method.settings.check import check_config
from neilfpp_method.settings.facts import SceneFacts
from neilfpp_method.settings.types import NeilfConfig, TrainConfig
from neilfpp_method.timing.ledger import Ledger
from neilfpp_method.train.budget_record import BudgetPlan, read_budget
from neilfpp_method.train.budgeted import (
    close_budget,
    plan_budget,
    plan_summary,
    planned_effects,
    planned_settings,
)
from neilfpp_method.train.checkpoint import last_checkpoint, load_checkpoint
from neilfpp_method.train.effects_record import read_plan
from neilfpp_method.train.output import default_folder
from neilfpp_method.train.request import TrainingRequest
from neilfpp_method.train.run import CaptureSource, Description, check_free, read_description
from neilfpp_method.train.trial import Workload
from neilfpp_method.train.work_record import read_work

__all__ = ["OpenRun", "open_run", "plan_run", "training_rays"]


@dataclass(frozen=True)
class OpenRun:
    """A run whose pixels are not read yet.

    Attributes:
        out: the run folder.
        plan: the effects, and the settings of the run before any decision on them.
        source: the location of the capture.
        capture: the capture, at the scale of the training.
        facts: the facts measured in the images; None for a new run, whose images are not read yet.
        budget: the plan for the time budget; None without a budget.
    """

    out: Path
    plan: Plan
    source: CaptureSource
    capture: Capture
    facts: SceneFacts | None
    budget: BudgetPlan | None

    @property
    def is_new(self) -> bool:
        """Whether the run folder is still to be created."""
        return self.facts is None


def open_run(request: TrainingRequest, ledger: Ledger) -> OpenRun | None:
    """Read an existing run, and add the time that it has taken so far to the ledger.

    Returns:
        The run; None if all its steps are trained.

    Raises:
        UserError: if there is no run, its capture is unreadable, or an option differs from that of the run.
    """
    if request.out is None:
        raise UserError("--resume needs the run's folder", "give it with --out RUN")
    out = request.out
    described = read_description(out)
    _check_unchanged(request, out, described)
    plan, budget = read_plan(out, described.config), read_budget(out)
    if request.effects not in (None, plan.request):
        raise UserError(f"{out}: its effects are '{plan.request}'", "leave --effects out, or start a new run")
    if request.budget not in (None, budget and budget.budget):
        has = "no budget" if budget is None else f"a budget of {format_duration(budget.budget)}"
        raise UserError(f"{out}: the run has {has}", "leave --budget out, or start a new run")
    ledger.add(read_work(out))
    if _is_finished(out, plan.config):
        if budget is not None and budget.took is None:
            # The command was stopped while it wrote the report.
            close_budget(out, budget, ledger.total)
        return None
    capture = described.source.load_again(out)
    return OpenRun(out, plan, described.source, capture, described.facts, budget)


def plan_run(
    request: TrainingRequest, device: torch.device, ledger: Ledger, report: bool, console: Console
) -> OpenRun:
    """Load the capture of a new run, and plan its effects, its steps and its image size.

    Args:
        request: the capture, the settings and the budget.
        device: the device of the training.
        ledger: the clock of the budget.
        report: whether the command ends by writing the report, which is part of the budget.
        console: where the plan for the budget is printed.

    Raises:
        UserError: if the options or the capture are unusable, the run folder is not free, or the budget is
            too small.
    """
    if request.data is None or request.config is None:
        raise UserError("no capture given", "name its folder with --data DIR")
    settings, wanted = request.config, request.effects or EffectRequest("as-set")
    check_effects(wanted, settings)
    _check_settings(Plan.begin(wanted, settings).config)
    out = request.out or default_folder(request.data, settings)
    check_free(out)
    source = CaptureSource(str(request.data.resolve()), request.test_every, request.response, request.format)
    capture = source.load()
    budget = None
    if request.budget is not None:
        if request.processes > 1:
            raise UserError("--budget plans for one process", "leave --devices and --nodes out")
        work = Workload(capture, settings, wanted, device, report)
        duration = format_duration(request.budget)
        console.print(f"budget {duration}: measuring a few steps of each stage", soft_wrap=True)
        budget = plan_budget(request.budget, work, ledger)
        finds_geometry = settings.host.kind == "volsdf"
        console.print(plan_summary(budget, finds_geometry), soft_wrap=True)
        settings = planned_settings(budget, settings)
    plan = Plan.begin(wanted, settings)
    if budget is not None:
        planned_effects(budget, plan)
    rays = training_rays(plan.config.train, request.processes)
    scale = scale_for_rays(capture.train_views, rays) if request.scale is None else request.scale
    frame = capture.normalization
    source = replace(source, scale=scale, unit=frame.scale, center=frame.center)
    return OpenRun(out, plan, source, at_scale(capture, scale), None, budget)


def training_rays(config: TrainConfig, processes: int) -> int:
    """Number of rays that all processes of a training draw together."""
    return config.rays * processes * total_steps(config)


def _check_unchanged(request: TrainingRequest, out: Path, described: Description) -> None:
    """Raise a `UserError` if the capture or the settings of a request differ from those of the run."""
    source = described.source
    requested = replace(
        source,
        root=source.root if request.data is None else str(request.data.resolve()),
        test_every=source.test_every if request.test_every is None else request.test_every,
        response=source.response if request.response == "auto" else request.response,
        format=request.format or source.format,
        scale=source.scale if request.scale is None else request.scale,
    )
    if requested != source or request.config not in (None, described.config):
        raise UserError(
            f"{out}: a run keeps its capture and its settings, and --resume was given with different ones",
            "leave these options out, or start a new run in another --out",
        )


def _is_finished(out: Path, config: NeilfConfig) -> bool:
    path = last_checkpoint(out)
    return path.exists() and load_checkpoint(path)["step"] >= total_steps(config.train)


def _check_settings(config: NeilfConfig) -> None:
    """Check the settings of a new run.

    Raises:
        UserError: if a setting is out of range, or the known map is unusable.
    """
    if min(stage_steps(config.train).values()) < 0 or total_steps(config.train) == 0:
        raise UserError(
            "the stages have no steps", "set --config.train.sdf-steps and the others to 0 or more"
        )
    check_config(config)
    if config.known_map is not None:
        check_environment(Path(config.known_map))
    if config.train.sdf_steps and config.loss.volume <= 0.0:
        raise UserError("--config.loss.volume is 0, so R is not compared with the images", "set it above 0")
