"""The expected loss of accuracy of a short training, and the measurements behind it."""

from __future__ import annotations

import itertools
from statistics import mean

import pytest

from benchmarks.tables import read_results
from neilfpp_method.budget.expected import MEASURED, described, expected_loss

FIGURES = {
    "base_color": "base_color_psnr_scaled",
    "roughness": "roughness_psnr",
    "metallic": "metallic_psnr",
    "normals": "normal_mae_deg",
}


def test_the_losses_are_those_of_the_table():
    (result,) = [result for result in read_results() if result.table == "part-of-the-steps"]
    figures = {(row.capture, row.name): row.figures for row in result.rows}
    captures = {capture for capture, _ in figures}
    assert len(captures) == 2
    for loss in MEASURED:
        for field, name in FIGURES.items():
            lost = mean(
                figures[capture, "100 %"][name] - figures[capture, f"{100 * loss.share:.0f} %"][name]
                for capture in captures
            )
            assert getattr(loss, field) == pytest.approx(-lost if field == "normals" else lost, abs=0.051)


def test_the_loss_falls_with_the_share():
    losses = [expected_loss(share) for share in (0.01, 0.1, 0.15, 0.3, 0.6, 0.999, 1.0, 3.0)]
    for name in FIGURES:
        values = [getattr(loss, name) for loss in losses]
        assert all(before >= after for before, after in itertools.pairwise(values))
        assert values[0] == values[1] == getattr(MEASURED[0], name)
        assert values[3] == pytest.approx(getattr(MEASURED[1], name))
        assert values[-1] == values[-2] == 0.0
    middle = (losses[1].metallic + losses[3].metallic) / 2
    assert expected_loss((0.1 * 0.3) ** 0.5).metallic == pytest.approx(middle)


def test_the_description_names_what_was_measured():
    text = described(0.3)
    assert "30% of the steps" in text
    assert "base colour 3.2, roughness 1.9 and metallic 3.7 dB, normals 1.0° worse" in text
    assert described(2.0) == "expected accuracy: that of all steps of the settings"
