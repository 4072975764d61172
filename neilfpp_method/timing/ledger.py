"""A ledger of seconds, by stage and by kind of work.

Code that computes says which kind of work begins, and nothing else; without a ledger that costs a comparison:

    with doing("tracing"):
        hits = host.scene_light(x, wi)

A ledger that listens gives every moment to one kind: within `doing("tracing")` that of "shading" stands
still. So its seconds add up to the time since it was made, and what no code has named is "rest".

On a GPU the clock of the host shows when work was asked for, not when it was done. A ledger that is given
`synchronise` waits for the device whenever the kind of work changes, but only in one of `EVERY` steps; the
time of the other steps of a stage is shared out as that of those that were told apart.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator, Mapping
from contextlib import ContextDecorator, contextmanager
from typing import Literal, get_args

__all__ = ["EVERY", "PREPARATION", "WORK", "Ledger", "Work", "doing", "listening"]

Work = Literal[
    "data",
    "rendering",
    "regularisers",
    "tracing",
    "shading",
    "gradients",
    "optimiser",
    "light_fits",
    "looks",
    "saving",
    "rest",
]
"""Drawing pixels · rays of cameras through the host · losses on geometry and material alone · rays that leave
surfaces · material, light and the rendering equation · the backward pass of all of these · the descent and
its bookkeeping · solving for maps and lamps · pictures and figures on the way · checkpoints · what else there
is.
"""
WORK: tuple[Work, ...] = get_args(Work)
PREPARATION = "preparation"
"""The stage before the first: images are read, the model is made."""
EVERY = 200
"""On a GPU, one step in so many is told apart. A step that waits at each change of work takes at most about
twice as long, so this costs at most half a per cent; an estimate, as no GPU was measured.
"""
FIRST = 10
"""On a GPU, the step of a stage that is told apart first: those before it compile and allocate."""


class Ledger:
    """Seconds by stage and by work; begins to count when it is made.

    Args:
        synchronise: waits until a device has done what it was asked; none: work is done when its call
            returns.
        now: a clock, seconds.
    """

    def __init__(
        self,
        synchronise: Callable[[], object] | None = None,
        now: Callable[[], float] = time.perf_counter,
    ) -> None:
        self._seconds: dict[str, dict[str, float]] = {}
        self._untold: dict[str, float] = {}
        self._told: dict[str, dict[str, float]] = {}
        self._synchronise, self._now = synchronise, now
        self._stage, self._work = PREPARATION, "rest"
        self._in_step = self._apart = False
        self._tells = synchronise is None
        self._since = now()

    def add(self, seconds: Mapping[str, Mapping[str, float]]) -> None:
        """What was counted before, in a training that is continued."""
        for stage, parts in seconds.items():
            counted = self._seconds.setdefault(stage, {})
            for work, passed in parts.items():
                counted[work] = counted.get(work, 0.0) + passed

    @property
    def total(self) -> float:
        """All seconds so far."""
        self._count()
        return sum(sum(parts.values()) for parts in self._seconds.values()) + sum(self._untold.values())

    def seconds(self) -> dict[str, dict[str, float]]:
        """Seconds by stage and by work so far; kinds that took no time are absent."""
        self._count()
        counted = {stage: dict(self._seconds.get(stage, {})) for stage in {**self._seconds, **self._untold}}
        for stage, untold in self._untold.items():
            told = self._told.get(stage) or {"rest": 1.0}
            for work, part in told.items():
                counted[stage][work] = counted[stage].get(work, 0.0) + untold * part / sum(told.values())
        return counted

    def enter(self, stage: str) -> None:
        """From now on all time is of this stage."""
        self._count()
        self._stage = stage

    @contextmanager
    def step(self, number: int) -> Iterator[None]:
        """A step of the stage, by its number in it."""
        self._count()
        self._in_step = True
        self._tells = self._synchronise is None or number % EVERY == FIRST
        self._wait()
        try:
            yield
        finally:
            self._wait()
            self._count()
            self._in_step, self._tells = False, self._synchronise is None

    def begin(self, work: Work, apart: bool) -> tuple[Work, bool]:
        """Work of another kind begins. Returns what was done before, to go back to."""
        before = self._work, self._apart
        if not self._apart:
            if apart or self._tells:
                self._wait(always=apart)
                self._count()
            self._work, self._apart = work, apart
        return before

    def back_to(self, before: tuple[Work, bool]) -> None:
        """Work of the kind that `begin` returned goes on."""
        if before == (self._work, self._apart):
            return
        if self._apart or self._tells:
            self._wait(always=self._apart)
            self._count()
        self._work, self._apart = before

    def _wait(self, always: bool = False) -> None:
        if self._synchronise is not None and (always or self._tells):
            self._synchronise()

    def _count(self) -> None:
        """What has passed since the last time goes to what was done."""
        now = self._now()
        passed, self._since = now - self._since, now
        if self._in_step and not self._apart and not self._tells:
            self._untold[self._stage] = self._untold.get(self._stage, 0.0) + passed
            return
        kept = [self._seconds]
        if self._in_step and not self._apart and self._synchronise is not None:
            kept.append(self._told)
        for seconds in kept:
            parts = seconds.setdefault(self._stage, {})
            parts[self._work] = parts.get(self._work, 0.0) + passed


_ledger: Ledger | None = None


@contextmanager
def listening(ledger: Ledger) -> Iterator[Ledger]:
    """The ledger that is told of all work within; one at a time in a process."""
    global _ledger
    before, _ledger = _ledger, ledger
    try:
        yield ledger
    finally:
        _ledger = before


class doing(ContextDecorator):
    """Tells the listening ledger, if any, what kind of work is done within. Also a decorator.

    Args:
        work: the kind.
        apart: nothing within is told apart, as in a fit of the light that traces rays of its own; and the
            device is always waited for, as this is rare and no part of every step.
    """

    def __init__(self, work: Work, apart: bool = False) -> None:
        self._does = work, apart
        self._before: list[tuple[Ledger, tuple[Work, bool]] | None] = []

    def __enter__(self) -> None:
        self._before.append(None if _ledger is None else (_ledger, _ledger.begin(*self._does)))

    def __exit__(self, *_: object) -> None:
        before = self._before.pop()
        if before is not None:
            before[0].back_to(before[1])
