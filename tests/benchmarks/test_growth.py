"""The straight line that is fitted to a cost, on figures with a known line."""

from __future__ import annotations

import pytest

from benchmarks import growth
from benchmarks.growth import Growth, straight_line, table
from neilfpp_method.settings.plain import changed
from neilfpp_method.volume.partition import sample_counts
from tests.scenes import sphere_model, tiny_config


def test_a_straight_line_is_found_and_deviations_are_reported():
    numbers = (1, 2, 4, 8)
    line = straight_line(Growth("a", numbers, tuple(0.5 + 0.25 * n for n in numbers)))
    assert (line.fixed, line.each, line.off) == pytest.approx((0.5, 0.25, 0.0), abs=1e-12)
    assert straight_line(Growth("b", numbers, tuple(0.1 * n * n for n in numbers))).off > 0.2


def test_the_table_has_the_line():
    text = table([Growth("steps over rays", (1, 2, 3), (1.5, 2.0, 2.5))])
    assert "| CPU time | 1.5e+03 ms | 2e+03 ms | 2.5e+03 ms | 1e+03 ms + 5e+02 ms each | 0 % |" in text


def test_a_step_has_the_samples_of_its_settings(monkeypatch):
    model, config = sphere_model(tiny_config()), changed(tiny_config(), {"host.volume.samples": 12})
    monkeypatch.setattr(growth, "seconds_of", lambda step: 1.0)
    growth.step_seconds(model, config, 8)
    assert model.host.sample_counts == sample_counts(config.host.volume)
