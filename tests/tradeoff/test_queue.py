"""The queue of runs, with jobs that only pretend to work."""

from __future__ import annotations

from pathlib import Path

import pytest

from neilfpp_method.tradeoff import queue
from neilfpp_method.tradeoff.ending import Ending
from neilfpp_method.tradeoff.planned_runs import PlannedRun
from neilfpp_method.tradeoff.queue import work_through
from tests.train.small_runs import small_config


def planned(name: str, budget: float) -> PlannedRun:
    return PlannedRun(Path("data"), Path("out") / name, small_config(), "auto", budget)


class StandIn:
    """A job that ends after a number of looks, or when it is stopped."""

    def __init__(self, looks: int, ending: Ending) -> None:
        self.looks, self.result, self.stops = looks, ending, 0

    def done(self) -> bool:
        self.looks -= 1
        return self.looks < 0 or self.stops > 0

    def ending(self) -> Ending:
        return self.result

    def stop(self) -> None:
        self.stops += 1


class Engine:
    """Starts these jobs in order, and records which were started where."""

    def __init__(self, places: tuple[str, ...], jobs: list[StandIn]) -> None:
        self.places, self.jobs, self.started = places, jobs, []

    def start(self, run: PlannedRun, place: str) -> StandIn:
        self.started.append((run.name, place))
        return self.jobs[len(self.started) - 1]


@pytest.fixture(autouse=True)
def no_sleep(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(queue, "POLL_SECONDS", 0.0)


def test_a_place_has_one_run_at_a_time_and_takes_the_next():
    engine = Engine(("a", "b"), [StandIn(looks, Ending()) for looks in (5, 1, 1, 1)])
    said, ended = [], []
    runs = [planned(f"run{k}", 60.0) for k in range(4)]
    work_through(runs, engine, said.append, lambda run, ending: ended.append(run.name))
    # The first run keeps its place while the other place takes all others.
    assert engine.started == [("run0", "a"), ("run1", "b"), ("run2", "b"), ("run3", "b")]
    assert ended == ["run1", "run2", "run0", "run3"]
    assert said[0] == "run 1 of 4: run0 on a"
    assert said[3] == "run 4 of 4: run3 on b"


def test_budgets_known_to_be_too_small_are_not_started():
    engine = Engine(("a",), [StandIn(0, Ending("too small", too_small=90.0)), StandIn(0, Ending())])
    ended = {}
    runs = [planned("1m-seed0", 60.0), planned("1m-seed1", 60.0), planned("90s", 90.0), planned("2m", 120.0)]
    work_through(runs, engine, lambda text: None, lambda run, ending: ended.update({run.name: ending}))
    assert [name for name, _ in engine.started] == ["1m-seed0", "2m"]
    assert "a budget of 1m is too small" in ended["1m-seed1"].left_out
    assert "give more than --budgets 1m30s" in ended["90s"].left_out
    assert ended["2m"] == Ending()


@pytest.mark.parametrize("impatient", [False, True])
def test_an_exception_stops_the_running_jobs(monkeypatch, impatient):
    """Ctrl-C while the queue waits; impatient: once more while it waits for the jobs to save their state."""
    jobs = [StandIn(1000, Ending()), StandIn(1000, Ending())]
    engine = Engine(("a", "b"), jobs)
    interrupts = iter([True, impatient])
    if impatient:
        for job in jobs:
            job.done = lambda job=job: job.stops > 1

    def sleep(seconds: float) -> None:
        if next(interrupts, False):
            raise KeyboardInterrupt

    monkeypatch.setattr(queue.time, "sleep", sleep)
    said = []
    with pytest.raises(KeyboardInterrupt):
        work_through(
            [planned(f"run{k}", 60.0) for k in range(3)], engine, said.append, lambda run, ending: None
        )
    assert [job.stops for job in jobs] == [2 if impatient else 1] * 2
    assert len(engine.started) == 2
    assert "the same command continues them" in said[-1]
