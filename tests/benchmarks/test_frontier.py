"""Frontiers of `neilfpp tradeoff` as rows of a table."""

from __future__ import annotations

import json

import pytest

from benchmarks.frontier import frontier_rows, read_runs
from neilfpp_method.errors import UserError


def test_a_budget_has_a_mean_and_with_several_seeds_a_deviation(tmp_path):
    runs = [
        {"budget": 180.0, "seed": 0, "seconds": 179.0, "figures": {"pbr_psnr": 20.0, "held_back_psnr": 5.0}},
        {"budget": 180.0, "seed": 1, "seconds": 181.0, "figures": {"pbr_psnr": 24.0, "held_back_psnr": 5.0}},
        {"budget": 600.0, "seed": 0, "seconds": 600.0, "figures": {"pbr_psnr": 25.0, "held_back_psnr": 5.0}},
    ]
    (tmp_path / "tradeoff.json").write_text(json.dumps({"runs": runs}))
    rows = frontier_rows("teapot", read_runs(tmp_path))
    assert [row.name for row in rows] == ["3m, mean of 2", "3m, standard deviation", "10m"]
    assert rows[0].figures == {"pbr_psnr": 22.0, "seconds": 180.0}
    assert rows[1].figures == {"pbr_psnr": pytest.approx(8.0**0.5)}
    assert rows[2].figures == {"pbr_psnr": 25.0, "seconds": 600.0}
    with pytest.raises(UserError, match="no tradeoff"):
        read_runs(tmp_path / "runs")
