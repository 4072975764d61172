"""The runs of a tradeoff. Each is an ordinary run folder, which `neilfpp train --resume` can continue."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path

from rich.console import Console

from neilfpp_method.budget.durations import format_duration
from neilfpp_method.effects.request import parse_effects
from neilfpp_method.errors import UserError
from neilfpp_method.evaluate.protocols import evaluate, write_metrics
from neilfpp_method.evaluate.size import at_size
from neilfpp_method.relight.maps import Layout
from neilfpp_method.report.files import flat_settings
from neilfpp_method.report.measured import is_outdated
from neilfpp_method.settings.plain import to_dict
from neilfpp_method.settings.types import NeilfConfig
from neilfpp_method.tradeoff.frontier import FIGURES, RunResult
from neilfpp_method.tradeoff.relighting import Relighting, has_relit, metrics_path, relight_run
from neilfpp_method.train.budget_record import read_budget
from neilfpp_method.train.budgeted import planned_settings
from neilfpp_method.train.command import run_training
from neilfpp_method.train.device import pick_device
from neilfpp_method.train.effects_record import read_plan
from neilfpp_method.train.json_files import read_json
from neilfpp_method.train.pace import with_steps
from neilfpp_method.train.quality import read_checks
from neilfpp_method.train.request import TrainingRequest
from neilfpp_method.train.run import CaptureSource, load_run, read_description

__all__ = ["PlannedRun", "TradeoffRequest", "check_same", "is_complete", "make_run", "measured", "plan_runs"]

METRICS = "metrics.json"
"""File of a run with its metrics on test views."""


@dataclass(frozen=True)
class TradeoffRequest:
    """The runs of a tradeoff.

    Attributes:
        data: folder of the capture.
        out: folder for the runs and the frontier.
        config: the settings of all runs; the seeds start at that of the settings.
        budgets: the time budgets, in seconds.
        seeds: number of runs per budget.
        device: value of `--device`: the device, or several separated by commas.
        slurm: value of `--slurm`; None to train on this machine.
        relight, truth, env_layout: values of the options of these names.
    """

    data: Path
    out: Path
    config: NeilfConfig
    budgets: Sequence[float]
    seeds: int
    device: str
    slurm: str | None = None
    relight: Path | None = None
    truth: Path | None = None
    env_layout: Layout = "ours"


@dataclass(frozen=True)
class PlannedRun:
    """Description of a run to make.

    Attributes:
        data: folder of the capture.
        out: the run folder.
        config: the settings, including the seed.
        effects: value of `--effects`.
        budget: time budget, in seconds.
        light: light under which it is compared with true images; None if it is not compared.
    """

    data: Path
    out: Path
    config: NeilfConfig
    effects: str
    budget: float
    light: Relighting | None = None

    @property
    def name(self) -> str:
        """Name of the run: that of its folder."""
        return self.out.name


def plan_runs(request: TradeoffRequest) -> list[PlannedRun]:
    """Plan a run for each budget and seed, by budget, with the folders `OUT/10m-seed0` and so on.

    Raises:
        UserError: if there is no budget, a budget occurs twice, or `seeds` is less than 1.
    """
    budgets, config = request.budgets, request.config
    if not budgets or len(set(map(format_duration, budgets))) != len(budgets):
        raise UserError("--budgets is empty or contains a budget twice", "give each once, as 1m,3m,10m")
    if request.seeds < 1:
        raise UserError(f"--seeds is {request.seeds}", "set it to 1 or more")
    effects = "as-set" if config.preset.startswith("paper-") else "auto"
    runs = []
    for budget in sorted(budgets):
        for seed in range(config.train.seed, config.train.seed + request.seeds):
            out = request.out / f"{format_duration(budget)}-seed{seed}"
            seeded = replace(config, train=replace(config.train, seed=seed))
            runs.append(PlannedRun(request.data, out, seeded, effects, budget))
    return runs


def check_same(run: PlannedRun) -> None:
    """Check that the folder of a planned run, if it contains a run, contains that run.

    The numbers of steps and the settings that depend on the size of a step (`budget.sizes`) are compared with
    the plan of the run, because planning for a budget changes them.

    Raises:
        UserError: if anything else differs; the message names the first difference.
    """
    if not (run.out / "config.json").is_file():
        return
    described = read_description(run.out)
    plan = read_budget(run.out)
    planned = run.config if plan is None else planned_settings(plan, run.config)
    effects = str(read_plan(run.out, described.config).request)
    kept = described.source
    source = CaptureSource(str(run.data.resolve()), scale=kept.scale, unit=kept.unit, center=kept.center)
    wanted = _compared(planned, source, run.budget, str(parse_effects(run.effects)))
    stored = _compared(described.config, described.source, plan and plan.budget, effects)
    for name in dict.fromkeys((*stored, *wanted)):
        if stored.get(name) != wanted.get(name):
            raise UserError(
                f"{run.out}: a run of another capture or with other settings: {name} is {stored.get(name)}, "
                f"not {wanted.get(name)}",
                "choose another --out, or remove this folder",
            )


def _compared(
    config: NeilfConfig, source: CaptureSource, budget: float | None, effects: str
) -> dict[str, object]:
    """The values, by name, that must agree for a run folder to contain a planned run."""
    capture = {f"capture.{name}": value for name, value in asdict(source).items()}
    settings = flat_settings(to_dict(replace(config, train=with_steps(config.train, {}))))
    return {**capture, **settings, "--effects": effects, "the budget in seconds": budget}


def make_run(
    run: PlannedRun, device: str, console: Console, report: Callable[[Path, str], None] | None = None
) -> None:
    """Train, evaluate and relight a run, or only do the parts that are missing.

    Args:
        run: the run.
        device: name of the device.
        console: where progress is printed.
        report: called with the folder and the device when the run has been trained, within its budget.

    Raises:
        UserError: for example if the budget is too small for this machine.
    """
    if not _is_trained(run):
        exists = (run.out / "config.json").is_file()
        request = TrainingRequest(
            data=None if exists else run.data,
            out=run.out,
            config=None if exists else run.config,
            resume=exists,
            effects=None if exists else parse_effects(run.effects),
            budget=run.budget,
            device=device,
        )
        run_training(request, console, (lambda path: report(path, device)) if report else None)
    if not _has_metrics(run.out):
        trained = at_size(load_run(run.out, pick_device(device)), None, None)
        if trained.capture.test_views:
            write_metrics(run.out / METRICS, trained, evaluate(trained))
    if run.light is not None and not has_relit(run.out, run.light):
        relight_run(run.out, run.light, device, lambda text: console.print(text, soft_wrap=True))


def is_complete(run: PlannedRun, with_tests: bool) -> bool:
    """Whether nothing of a run is missing; `with_tests` tells whether the capture has test views."""
    return (
        _is_trained(run)
        and (_has_metrics(run.out) or not with_tests)
        and (run.light is None or has_relit(run.out, run.light))
    )


def measured(run: PlannedRun) -> RunResult | None:
    """The result of a run; None if it is not finished.

    Raises:
        UserError: if a file of the run is damaged.
    """
    plan = read_budget(run.out)
    if plan is None or plan.took is None:
        return None
    known = read_json(run.out / METRICS) if _has_metrics(run.out) else {}
    if run.light is not None and has_relit(run.out, run.light):
        known = {**known, **read_json(metrics_path(run.out, run.light))}
    figures = {name: float(known[name]) for name in FIGURES if isinstance(known.get(name), int | float)}
    checks = read_checks(run.out)
    if checks:
        last = checks[-1]
        figures["held_back_psnr"] = last.radiance if last.physical is None else last.physical
    return RunResult(run.budget, run.config.train.seed, plan.took, figures)


def _is_trained(run: PlannedRun) -> bool:
    plan = read_budget(run.out)
    return plan is not None and plan.took is not None


def _has_metrics(folder: Path) -> bool:
    """Whether a run has metrics that are not older than its last checkpoint."""
    return (folder / METRICS).is_file() and not is_outdated(folder / METRICS, folder)
