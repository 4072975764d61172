"""Work through the runs of a tradeoff: start each as soon as there is a place for it."""

from __future__ import annotations

import time
from collections import deque
from collections.abc import Callable, Sequence
from contextlib import suppress
from typing import Protocol, runtime_checkable

from rich.console import Console

from neilfpp_method.budget.durations import format_duration
from neilfpp_method.tradeoff.ending import Ending, Report, attempt
from neilfpp_method.tradeoff.planned_runs import PlannedRun

__all__ = ["Engine", "Job", "ThisProcess", "work_through"]

POLL_SECONDS = 0.5
"""Seconds between two looks at the running jobs."""


@runtime_checkable
class Job(Protocol):
    """A run that has been started."""

    def done(self) -> bool:
        """Whether it has ended."""

    def ending(self) -> Ending:
        """How it ended."""

    def stop(self) -> None:
        """Ask it to save its state and end; a second time: to end at once."""


@runtime_checkable
class Engine(Protocol):
    """What starts runs.

    Attributes:
        places: names of the places of which each has at most one run at a time.
    """

    places: Sequence[str]

    def start(self, run: PlannedRun, place: str) -> Job:
        """Start a run in a place."""


class ThisProcess:
    """Makes one run after the other in this process."""

    def __init__(self, device: str, console: Console, report: Report | None) -> None:
        self.places = (device,)
        self._console = console
        self._report = report

    def start(self, run: PlannedRun, place: str) -> Job:
        """Make a run. Returns when it has ended."""
        return _Ended(attempt(run, place, self._console, self._report))


class _Ended:
    def __init__(self, ending: Ending) -> None:
        self._ending = ending

    def done(self) -> bool:
        return True

    def ending(self) -> Ending:
        return self._ending

    def stop(self) -> None:
        pass


def work_through(
    runs: Sequence[PlannedRun],
    engine: Engine,
    say: Callable[[str], None],
    on_end: Callable[[PlannedRun, Ending], None],
) -> None:
    """Make all runs, in their order, as many at a time as the engine has places.

    A run whose budget an earlier run has shown to be too small is not started. If anything is raised, for
    example by Ctrl-C, the running jobs are stopped first.

    Args:
        runs: the runs.
        engine: starts them.
        say: receives a line when a run starts.
        on_end: called when a run has ended.
    """
    waiting = deque(enumerate(runs, start=1))
    running: dict[str, tuple[PlannedRun, Job]] = {}
    too_small = 0.0
    try:
        while waiting or running:
            for place in engine.places:
                if place in running or not waiting:
                    continue
                number, run = waiting.popleft()
                if run.budget <= too_small:
                    on_end(run, Ending(_known_too_small(run, too_small)))
                    continue
                where = f" on {place}" if len(engine.places) > 1 else ""
                say(f"run {number} of {len(runs)}: {run.name}{where}")
                running[place] = run, engine.start(run, place)
            ended = {place: item for place, item in running.items() if item[1].done()}
            for place, (run, job) in ended.items():
                del running[place]
                ending = job.ending()
                too_small = max(too_small, ending.too_small)
                on_end(run, ending)
            if running and not ended:
                time.sleep(POLL_SECONDS)
    finally:
        if running:
            _stop([job for _, job in running.values()], say)


def _known_too_small(run: PlannedRun, too_small: float) -> str:
    return (
        f"a budget of {format_duration(run.budget)} is too small, as an earlier run has measured; give more "
        f"than --budgets {format_duration(too_small)}"
    )


def _stop(jobs: Sequence[Job], say: Callable[[str], None]) -> None:
    """Stop jobs and wait until they have ended. Ctrl-C while waiting ends them at once."""
    say("stopping; runs in training save their state, and the same command continues them")
    for job in jobs:
        job.stop()
    try:
        _wait(jobs)
    except KeyboardInterrupt:
        for job in jobs:
            job.stop()
        with suppress(KeyboardInterrupt):
            _wait(jobs)


def _wait(jobs: Sequence[Job]) -> None:
    while not all(job.done() for job in jobs):
        time.sleep(POLL_SECONDS)
