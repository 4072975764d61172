"""Curves of quality over time: measured in a few steps, drawn, and written as a table."""

from __future__ import annotations

from pathlib import Path

import pytest
import torch

from benchmarks import time_to_quality
from benchmarks.time_to_quality import FIGURES, Curve, Mark, curve, table
from neilfpp_method.demo.command import demo_scene
from tests.scenes import tiny_config


@pytest.fixture(scope="module")
def measured() -> Curve:
    return curve(
        demo_scene(), tiny_config(), cap=float("inf"), first=1e-3, views=1, device=torch.device("cpu")
    )


@pytest.mark.slow
def test_measurements_continue_to_the_end_and_include_the_material_stage(measured):
    assert measured.finished
    assert [mark.step for mark in measured.marks] == sorted({mark.step for mark in measured.marks})
    assert all(a.seconds < b.seconds for a, b in zip(measured.marks, measured.marks[1:], strict=False))
    assert set(measured.marks[0].figures) == {"volume_psnr"}
    assert set(measured.marks[-1].figures) == set(FIGURES)


def test_a_time_limit_ends_a_curve_and_is_noted():
    capped = curve(demo_scene(), tiny_config(), cap=1e-6, first=1.0, views=1, device=torch.device("cpu"))
    assert [mark.step for mark in capped.marks] == [1]
    assert not capped.finished
    assert "| 1 of 12 |" in table({"tiny": capped})
    assert list(time_to_quality.charts(Path("scene"), {"tiny": capped})[0].lines) == ["tiny, unfinished"]


@pytest.mark.slow
def test_a_measurement_does_not_change_the_training(measured):
    again = curve(
        demo_scene(), tiny_config(), cap=float("inf"), first=1e9, views=1, device=torch.device("cpu")
    )
    assert again.marks[-1].figures == pytest.approx(measured.marks[-1].figures)


def test_a_missing_figure_is_a_dash():
    marks = (Mark(1.0, 5, {"volume_psnr": 20.0}), Mark(2.0, 10, {"volume_psnr": 21.0, "roughness_psnr": 9.0}))
    measured = Curve(marks, 10)
    assert "| p | 1 | 5 of 10 | 20.00 | – | – | – | – |" in table({"p": measured})
    assert measured.line("roughness_psnr").x == (2.0,)
    assert measured.line("metallic_psnr") is None
