"""The frontier of accuracy over time: means, deviations, gains per minute and dominated budgets, by hand; and
its files.
"""

from __future__ import annotations

import csv
import json
import math
import re

import pytest

from neilfpp_method.tradeoff.command import frontier_table
from neilfpp_method.tradeoff.figure import draw_frontier
from neilfpp_method.tradeoff.files import write_tradeoff
from neilfpp_method.tradeoff.frontier import RunResult, frontier


def runs_of(*figures: tuple[float, float, float], seed: int = 0) -> list[RunResult]:
    """Runs of one seed: seconds, dB of base colour, degrees of normals."""
    return [
        RunResult(seconds, seed, seconds, {"base_color_psnr_scaled": decibels, "normal_mae_deg": degrees})
        for seconds, decibels, degrees in figures
    ]


def test_the_gain_per_minute():
    points = frontier(runs_of((180.0, 26.0, 8.0), (60.0, 20.0, 10.0)))
    assert [point.budget for point in points] == [60.0, 180.0]
    assert points[0].per_minute == {}
    assert points[1].per_minute == {"base_color_psnr_scaled": 3.0, "normal_mae_deg": -1.0}
    assert [point.dominated for point in points] == [False, False]


def test_a_budget_is_dominated_by_one_that_took_no_longer_and_is_as_good():
    worse = frontier(runs_of((60.0, 20.0, 10.0), (120.0, 19.0, 10.0), (240.0, 21.0, 11.0)))
    # The second is worse in one figure and equal in the other; the third is better in one.
    assert [point.dominated for point in worse] == [False, True, False]
    equal = frontier(runs_of((60.0, 20.0, 10.0), (120.0, 20.0, 10.0)))
    assert [point.dominated for point in equal] == [False, False]


def test_seeds_have_a_mean_and_a_deviation():
    points = frontier([*runs_of((60.0, 20.0, 10.0)), *runs_of((60.0, 24.0, 10.0), seed=1)])
    assert len(points) == 1
    assert points[0].runs == 2
    assert points[0].figures["base_color_psnr_scaled"] == 22.0
    assert points[0].deviations["base_color_psnr_scaled"] == pytest.approx(math.sqrt(8.0))
    assert points[0].deviations["normal_mae_deg"] == 0.0


def test_only_figures_that_all_runs_have_are_compared():
    runs = [
        RunResult(60.0, 0, 60.0, {"held_back_psnr": 20.0, "pbr_psnr": 1.0}),
        *runs_of((120.0, 20.0, 10.0)),
    ]
    assert frontier(runs)[0].figures == {}
    assert not any(point.dominated for point in frontier(runs))
    assert frontier([]) == []


def test_the_files_agree(tmp_path):
    runs = runs_of((60.0, 20.0, 10.0), (120.0, 19.0, 10.0))
    write_tradeoff(tmp_path, "a <scene>", runs)
    lines = list(csv.DictReader((tmp_path / "tradeoff.csv").open()))
    assert [line["budget"] for line in lines] == ["1m", "2m"]
    assert [line["dominated"] for line in lines] == ["no", "yes"]
    assert [float(line["base_color_psnr_scaled"]) for line in lines] == [20.0, 19.0]
    stored = json.loads((tmp_path / "tradeoff.json").read_text())
    assert [point["dominated"] for point in stored["points"]] == [False, True]
    assert stored["machine"]["cores"]
    assert "command" not in stored["machine"]
    drawn = (tmp_path / "tradeoff.svg").read_text()
    assert "a &lt;scene&gt;" in drawn
    for label in ("1m: 20.00", "2m: 19.00", "1m: 10.00", "2m: 10.00"):
        assert label in drawn  # every point has its label
    assert "2m" in "".join(frontier_table(frontier(runs)))
    assert sum("dominated" in line for line in frontier_table(frontier(runs))) == 1


def test_better_is_higher_and_later_is_further_right():
    drawn = draw_frontier("t", frontier(runs_of((60.0, 20.0, 10.0), (120.0, 25.0, 8.0))))
    (x, y), (later, above) = re.findall(r'<circle cx="([\d.]+)" cy="([\d.]+)"', drawn)[:2]
    assert float(later) > float(x)
    assert float(above) < float(y)
