"""The comparison of figures with a baseline, and the contents of a saved baseline."""

from __future__ import annotations

import time

import pytest
from rich.console import Console

from benchmarks.__main__ import SUITES, Options, compare, main, merged
from benchmarks.measure import Measurement, hardware, in_yardsticks, median_seconds
from neilfpp_method.errors import UserError


@pytest.mark.parametrize(
    ("better", "value", "worse"),
    [
        ("lower", 1.19, False),  # 19 % more, where 20 % are allowed
        ("lower", 1.21, True),
        ("lower", 0.1, False),
        ("higher", 0.84, False),  # 1 / 1.2 = 0.833
        ("higher", 0.82, True),
        ("higher", 9.0, False),
    ],
)
def test_worse_depends_on_direction_and_tolerance(better, value, worse):
    assert Measurement("a", value, "×", better, tolerance=0.2).worse_than(1.0) == worse
    assert not Measurement("a", value, "×", better).worse_than(1.0)


def test_a_comparison_names_worse_figures_and_ignores_new_ones():
    measured = [Measurement(name, 2.0, "×", "lower", tolerance=0.5) for name in ("slower", "same", "new")]
    assert compare(measured, {"slower": 1.0, "same": 2.0, "gone": 0.1}) == ["slower"]


def test_a_saved_baseline_keeps_the_figures_that_were_not_measured():
    old = {"hardware": "another", "figures": {"kept": {"value": 1.0}, "replaced": {"value": 1.0}}}
    new = merged([Measurement("replaced", 2.0, "×", "higher", 0.1)], old, "this")
    assert new["hardware"] == "this"
    assert list(new["figures"]) == ["kept", "replaced"]
    assert new["figures"]["replaced"] == {"value": 2.0, "unit": "×", "better": "higher", "tolerance": 0.1}


def test_durations_are_medians_of_alternating_runs():
    calls = []

    def work() -> None:
        calls.append("long")
        until = time.process_time() + 0.01
        while time.process_time() < until:
            pass

    short, long = median_seconds(lambda: calls.append("short"), work, repetitions=3)
    assert short < 0.01 <= long
    assert calls == ["short", "long"] * 4  # the first calls do not count
    assert in_yardsticks(lambda: None, repetitions=1) < 0.5


def test_the_machine_is_one_line():
    assert "\n" not in hardware()
    assert "thread" in hardware()


def test_an_unknown_suite_is_refused():
    with pytest.raises(UserError, match="choose among kernels, "):
        main(Options(names=("nothing",)), Console(quiet=True))
    assert set(SUITES) >= {"kernels", "shading", "steps"}
