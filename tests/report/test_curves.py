"""The charts of time and quality: every value is drawn at its position."""

from __future__ import annotations

import re

import pytest

from neilfpp_method.report.curves import (
    BOTTOM,
    HEIGHT,
    LABEL_HEIGHT,
    LEFT,
    RIGHT,
    TOP,
    WIDTH,
    quality_curve,
    work_bars,
)
from neilfpp_method.train.quality import QualityCheck


def points(svg: str) -> list[list[tuple[float, float]]]:
    lines = re.findall(r'<polyline points="([^"]*)"', svg)
    return [[tuple(map(float, point.split(","))) for point in line.split()] for line in lines]


def test_checks_are_drawn_at_their_positions():
    checks = [
        QualityCheck(10, "sdf_init", 0.0, 20.0, None, 0.1),
        QualityCheck(20, "joint", 50.0, 25.0, 22.0, 0.1),
        QualityCheck(30, "joint", 100.0, 30.0, 24.0, 0.1),
    ]
    svg = quality_curve(checks)
    radiance, physical = points(svg)
    bottom, right = HEIGHT - BOTTOM, WIDTH - RIGHT
    middle = (LEFT + right) / 2, (TOP + bottom) / 2
    assert radiance == [(LEFT, bottom), middle, (right, TOP)]  # 20 to 30 dB are the ends of the axis
    assert physical[0] == pytest.approx((middle[0], bottom - 0.2 * (bottom - TOP)))
    assert "R 30.0 dB" in svg
    assert "PBR 24.0 dB" in svg
    assert quality_curve([]) is None
    assert len(points(quality_curve(checks[:1]))) == 1  # no material yet


def test_bars_are_proportional_to_the_time():
    svg = work_bars(
        {"preparation": {"data": 1.0}, "joint": {"shading": 3.0, "gradients": 1.0}}, {"joint": "Joint"}
    )
    widths = [float(width) for width in re.findall(r'<rect [^>]*width="([^"]*)"', svg)]
    assert widths == pytest.approx([117.5, 352.5, 117.5])  # of the 470 that 4 s are long
    assert "shading: 3.0 s" in svg
    assert "Joint" in svg
    assert "rendering" not in svg
    assert work_bars({}, {}) is None


def test_labels_of_curves_with_the_same_end_do_not_overlap():
    svg = quality_curve([QualityCheck(10, "material_init", 5.0, 22.3, 22.4, 0.1)])
    heights = [float(y) for y in re.findall(r'y="([^"]*)"[^>]*>(?:R|PBR) [0-9.]+ dB<', svg)]
    assert len(heights) == 2
    assert abs(heights[0] - heights[1]) >= LABEL_HEIGHT
