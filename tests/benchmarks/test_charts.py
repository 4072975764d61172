"""Charts: lines are drawn at the positions that the axes define."""

from __future__ import annotations

import numpy as np
import pytest
from PIL import Image

from benchmarks.charts import COLORS, Chart, Line, draw_charts


def pixels_of(path, color) -> np.ndarray:
    """Rows and columns below the legend that have a colour."""
    picture = np.asarray(Image.open(path).convert("RGB")).astype(int)
    found = np.argwhere((np.abs(picture - color).max(-1)) < 12)
    return found[found[:, 0] > 130]


def test_a_decreasing_series_is_drawn_downwards(tmp_path):
    lines = {"first": Line((1, 10, 100), (5, 5, 5)), "falling": Line((1, 10, 100), (10, 1, 0.1))}
    draw_charts(tmp_path / "chart.png", "Title", "x", "y", [Chart("panel", lines)], columns=1)
    found = pixels_of(tmp_path / "chart.png", COLORS[1])
    left, right = found[found[:, 1].argmin()], found[found[:, 1].argmax()]
    assert right[0] > left[0] + 200
    middle = found[np.abs(found[:, 1] - (left[1] + right[1]) / 2) < 3][:, 0].mean()
    assert middle == pytest.approx((left[0] + right[0]) / 2, abs=4)  # equal steps of a logarithm are equal


def test_a_series_has_the_same_color_in_all_panels(tmp_path):
    rising = Line((1, 2), (1, 2))
    charts = [Chart("one", {"a": rising, "b": rising}), Chart("two", {"b": rising})]
    draw_charts(tmp_path / "chart.png", "", "x", "y", charts, columns=2)
    columns = pixels_of(tmp_path / "chart.png", COLORS[1])[:, 1]
    assert columns.min() < 480 < columns.max()
