"""The runs of a tradeoff. Each is an ordinary run folder, which `neilfpp train --resume` can continue."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

from rich.console import Console

from neilfpp_method.budget.durations import format_duration
from neilfpp_method.effects.request import parse_effects
from neilfpp_method.errors import UserError
from neilfpp_method.evaluate.protocols import evaluate, write_metrics
from neilfpp_method.evaluate.size import at_size
from neilfpp_method.settings.types import NeilfConfig
from neilfpp_method.tradeoff.frontier import FIGURES, Measured
from neilfpp_method.train.budget_record import read_budget
from neilfpp_method.train.command import run_training
from neilfpp_method.train.device import pick_device
from neilfpp_method.train.json_files import read_json
from neilfpp_method.train.quality import read_checks
from neilfpp_method.train.run import load_run

__all__ = ["Row", "measured", "rows_of", "run_row"]

METRICS = "metrics.json"
"""File of a run with its metrics on test views."""


@dataclass(frozen=True)
class Row:
    """Description of a run to make.

    Attributes:
        data: folder of the capture.
        out: the run folder.
        config: the settings, including the seed.
        effects: value of `--effects`.
        budget: time budget, in seconds.
        device: name of the device.
    """

    data: Path
    out: Path
    config: NeilfConfig
    effects: str
    budget: float
    device: str

    @property
    def name(self) -> str:
        """Name of the run: that of its folder."""
        return self.out.name


def rows_of(
    data: Path, out: Path, config: NeilfConfig, budgets: Sequence[float], seeds: int, device: str
) -> list[Row]:
    """A row for each budget and seed, in order of budget, with folders `OUT/10m-seed0` and so on.

    Raises:
        UserError: if there is no budget, a budget occurs twice, or `seeds` is less than 1.
    """
    if not budgets or len(set(budgets)) != len(budgets):
        raise UserError("--budgets is empty or contains a budget twice", "give each once, as 1m,3m,10m")
    if seeds < 1:
        raise UserError(f"--seeds is {seeds}", "set it to 1 or more")
    effects = "as-set" if config.preset.startswith("paper-") else "auto"
    rows = []
    for budget in sorted(budgets):
        for seed in range(config.train.seed, config.train.seed + seeds):
            seeded = replace(config, train=replace(config.train, seed=seed))
            rows.append(
                Row(data, out / f"{format_duration(budget)}-seed{seed}", seeded, effects, budget, device)
            )
    return rows


def run_row(row: Row, console: Console, at_end: Callable[[Path], None] | None = None) -> None:
    """Train and evaluate a run, or only the parts that are missing.

    Raises:
        UserError: for example if the budget is too small for this machine.
    """
    exists = (row.out / "config.json").is_file()
    plan = read_budget(row.out) if exists else None
    if plan is None or plan.took is None:
        run_training(
            data=None if exists else row.data,
            out=row.out,
            config=None if exists else row.config,
            resume=exists,
            test_every=None,
            response="auto",
            device=row.device,
            devices=1,
            console=console,
            effects=None if exists else parse_effects(row.effects),
            budget=row.budget,
            at_end=at_end,
        )
    if not (row.out / METRICS).is_file():
        run = at_size(load_run(row.out, pick_device(row.device)), None, None)
        if run.capture.test_views:
            write_metrics(row.out / METRICS, run, evaluate(run))


def measured(row: Row) -> Measured | None:
    """The result of a run; None if it is not finished.

    Raises:
        UserError: if a file of the run is damaged.
    """
    plan = read_budget(row.out)
    if plan is None or plan.took is None:
        return None
    metrics = read_json(row.out / METRICS) if (row.out / METRICS).is_file() else {}
    figures = {name: float(metrics[name]) for name in FIGURES if isinstance(metrics.get(name), int | float)}
    checks = read_checks(row.out)
    if checks:
        last = checks[-1]
        figures["held_back_psnr"] = last.radiance if last.physical is None else last.physical
    return Measured(row.budget, row.config.train.seed, plan.took, figures)
