"""Compute the frontier of accuracy over time from the metrics of runs.

For each budget these are means over the seeds, changes per minute, and whether another budget dominates it.
"""

from __future__ import annotations

import statistics
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

__all__ = ["FIGURES", "BudgetResult", "RunResult", "frontier"]


@dataclass(frozen=True)
class _Figure:
    title: str
    unit: str
    higher_is_better: bool


FIGURES: Mapping[str, _Figure] = {
    "base_color_psnr_scaled": _Figure("base colour, scaled", "dB", True),
    "roughness_psnr": _Figure("roughness", "dB", True),
    "metallic_psnr": _Figure("metallic", "dB", True),
    "normal_mae_deg": _Figure("normals", "degrees", False),
    "pbr_psnr": _Figure("novel view", "dB", True),
    "relight_psnr_scaled": _Figure("relit views, scaled", "dB", True),
    "held_back_psnr": _Figure("held-back pixels", "dB", True),
}
"""Metrics of `neilfpp eval`, as far as the capture has the truth for them, and that of `neilfpp relight
--truth`, if true images were given. The last one is measured at held-back pixels of training views
(`train.quality`) and always present.
"""


@dataclass(frozen=True)
class RunResult:
    """The result of a finished run.

    Attributes:
        budget: its time budget, in seconds.
        seed: its seed.
        seconds: time that it took.
        figures: its metrics by name, as in `FIGURES`.
    """

    budget: float
    seed: int
    seconds: float
    figures: Mapping[str, float]


@dataclass(frozen=True)
class BudgetResult:
    """The result of a budget.

    Attributes:
        budget: the time budget, in seconds.
        seconds: mean time that its runs took.
        runs: number of its runs.
        figures: means over its runs, for metrics that all runs have.
        deviations: standard deviations over its runs; empty if there is only one run.
        per_minute: change of each metric from the next smaller budget, per minute of additional time; empty
            for the smallest budget, and if the runs took no longer than those of the next smaller one.
        dominated: whether another budget whose runs took no longer is at least as good in every metric and
            better in one.
    """

    budget: float
    seconds: float
    runs: int
    figures: Mapping[str, float]
    deviations: Mapping[str, float]
    per_minute: Mapping[str, float]
    dominated: bool


def frontier(runs: Sequence[RunResult]) -> list[BudgetResult]:
    """The points of a frontier, by budget.

    >>> runs = [RunResult(60.0, 0, 60.0, {"pbr_psnr": 20.0}), RunResult(180.0, 0, 180.0, {"pbr_psnr": 26.0})]
    >>> [point.per_minute for point in frontier(runs)]
    [{}, {'pbr_psnr': 3.0}]
    """
    common = set(FIGURES).intersection(*(run.figures for run in runs)) if runs else set()
    names = [name for name in FIGURES if name in common]
    by_budget: dict[float, list[RunResult]] = {}
    for run in sorted(runs, key=lambda run: run.budget):
        by_budget.setdefault(run.budget, []).append(run)
    means = {
        budget: {name: statistics.fmean(run.figures[name] for run in group) for name in names}
        for budget, group in by_budget.items()
    }
    took = {budget: statistics.fmean(run.seconds for run in group) for budget, group in by_budget.items()}
    points, before = [], None
    for budget, group in by_budget.items():
        minutes = 0.0 if before is None else (took[budget] - took[before]) / 60.0
        gained = {} if minutes <= 0 else {n: (means[budget][n] - means[before][n]) / minutes for n in names}
        spread = {
            name: statistics.stdev(run.figures[name] for run in group) for name in names if len(group) > 1
        }
        others = [other for other in by_budget if other != budget and took[other] <= took[budget]]
        dominated = any(_dominates(means[other], means[budget], names) for other in others)
        points.append(
            BudgetResult(budget, took[budget], len(group), means[budget], spread, gained, dominated)
        )
        before = budget
    return points


def _dominates(one: Mapping[str, float], other: Mapping[str, float], names: Sequence[str]) -> bool:
    better = [(one[n] - other[n]) * (1 if FIGURES[n].higher_is_better else -1) for n in names]
    return bool(better) and min(better) >= 0 < max(better)
