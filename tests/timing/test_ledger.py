"""A ledger with a simulated clock: every second is attributed to one kind of work, and none is lost."""

from __future__ import annotations

import pytest

from neilfpp_method.timing.ledger import FIRST_SAMPLE, SAMPLE_INTERVAL, Ledger, recording, timed


class Clock:
    """A clock that stands still until it is advanced; waiting for the device takes `lag` seconds if work is
    pending there.
    """

    def __init__(self) -> None:
        self.time = self.lag = 0.0
        self.waits = 0

    def __call__(self) -> float:
        return self.time

    def synchronize(self) -> None:
        self.waits += 1
        self.time, self.lag = self.time + self.lag, 0.0


def test_nested_work_is_counted_separately():
    clock = Clock()
    with recording(Ledger(now=clock)) as ledger:
        clock.time = 1.0
        ledger.enter("joint")
        with ledger.step(0), timed("shading"):
            clock.time += 2.0
            with timed("tracing"):
                clock.time += 4.0
            clock.time += 8.0
        clock.time += 16.0
    assert ledger.seconds() == {
        "preparation": {"rest": 1.0},
        "joint": {"shading": 10.0, "tracing": 4.0, "rest": 16.0},
    }
    assert ledger.total == 31.0


def test_marks_within_a_fit_are_ignored_and_an_error_ends_it():
    clock = Clock()

    def fit():
        with timed("light_fits", undivided=True), timed("tracing"):
            clock.time += 3.0
            raise ValueError

    with recording(Ledger(now=clock)) as ledger:
        with pytest.raises(ValueError):
            fit()
        clock.time += 1.0
    assert ledger.seconds() == {"preparation": {"light_fits": 3.0, "rest": 1.0}}


def test_a_decorated_function_may_call_itself():
    clock = Clock()

    @timed("rendering")
    def render(depth: int) -> None:
        clock.time += 1.0
        if depth:
            render(depth - 1)

    with recording(Ledger(now=clock)) as ledger:
        render(2)
        clock.time += 5.0
    assert ledger.seconds() == {"preparation": {"rendering": 3.0, "rest": 5.0}}
    render(1)  # no ledger is active
    assert ledger.seconds()["preparation"]["rendering"] == 3.0


def test_earlier_seconds_are_added():
    clock = Clock()
    ledger = Ledger(now=clock)
    ledger.add({"preparation": {"rest": 2.0}, "joint": {"data": 1.5}})
    clock.time = 4.0
    assert ledger.seconds() == {"preparation": {"rest": 6.0}, "joint": {"data": 1.5}}


def test_a_device_is_sampled_and_its_time_is_divided():
    """The work of a device is visible only while waiting for it: 3 s of rendering and 1 s of shading in every
    step, 2 s in a fit.
    """
    clock, steps = Clock(), SAMPLE_INTERVAL + FIRST_SAMPLE + 1
    with recording(Ledger(synchronize=clock.synchronize, now=clock)) as ledger:
        ledger.enter("joint")
        for number in range(steps):
            with ledger.step(number):
                with timed("rendering"):
                    clock.lag += 3.0
                with timed("shading"):
                    clock.lag += 1.0
                if number == 5:
                    clock.synchronize()
                    with timed("light_fits", undivided=True):
                        clock.lag += 2.0
        clock.synchronize()
    seconds = ledger.seconds()["joint"]
    assert seconds["light_fits"] == pytest.approx(2.0)
    assert seconds["rendering"] == pytest.approx(3.0 * seconds["shading"])
    assert ledger.total == pytest.approx(clock.time)
    assert clock.waits < 0.1 * steps
