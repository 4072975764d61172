"""A ledger of seconds by stage and by kind of work.

Code that computes marks the kind of its work. Without a ledger that costs a single comparison:

    with timed("tracing"):
        hits = host.scene_light(x, wi)

A ledger attributes every moment to exactly one kind: within `timed("tracing")` the clock of an enclosing
"shading" stands still. So its seconds add up to the time since it was made; work that no code has marked is
"rest".

On a GPU the host clock shows when work is submitted, not when it is done. With `synchronize`, the ledger
waits for the device whenever the kind of work changes, but only in one of `SAMPLE_INTERVAL` steps (a sampled
step). The time of the other steps of a stage is divided in the proportions of the sampled ones.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator, Mapping
from contextlib import ContextDecorator, contextmanager
from typing import Literal, NamedTuple, get_args

__all__ = ["PREPARATION", "SAMPLE_INTERVAL", "WORK", "Ledger", "Work", "recording", "timed"]

Work = Literal[
    "data",
    "rendering",
    "regularizers",
    "tracing",
    "shading",
    "gradients",
    "optimizer",
    "light_fits",
    "checks",
    "saving",
    "rest",
]
"""The kinds of work.

- data: drawing pixels;
- rendering: camera rays through the host;
- regularizers: losses that depend only on geometry or material;
- tracing: rays that leave surfaces;
- shading: material, light and the rendering equation;
- gradients: the backward pass of all of these;
- optimizer: the optimizer step and its bookkeeping;
- light_fits: fits of the map and the lamps, and searches for materials under them;
- checks: previews and measurements during training;
- saving: checkpoints;
- rest: everything else.
"""
WORK: tuple[Work, ...] = get_args(Work)
"""All kinds of work."""
PREPARATION = "preparation"
"""Name of the time before the first stage, in which images are read and the model is built."""
SAMPLE_INTERVAL = 200
"""On a GPU, one in this many steps is sampled. A sampled step takes at most about twice as long, so this
costs at most half a per cent (an estimate; it has not been measured on a GPU).
"""
FIRST_SAMPLE = 10
"""On a GPU, the index of the first sampled step of a stage. The steps before it compile and allocate."""


class Mark(NamedTuple):
    """A kind of work, and whether all work within it counts as that kind; see `timed`."""

    work: Work
    undivided: bool


class Ledger:
    """Counts seconds by stage and by kind of work, from its construction on.

    Args:
        synchronize: waits until the device has finished its work; None if calls are synchronous.
        now: a clock, in seconds.
    """

    def __init__(
        self,
        synchronize: Callable[[], object] | None = None,
        now: Callable[[], float] = time.perf_counter,
    ) -> None:
        self._seconds: dict[str, dict[str, float]] = {}
        self._unsampled: dict[str, float] = {}
        self._sampled: dict[str, dict[str, float]] = {}
        self._synchronize, self._now = synchronize, now
        self._stage, self._mark = PREPARATION, Mark("rest", undivided=False)
        self._in_step = False
        self._samples = synchronize is None
        self._since = now()

    def add(self, seconds: Mapping[str, Mapping[str, float]]) -> None:
        """Add the seconds of earlier sessions of a run that is continued."""
        for stage, parts in seconds.items():
            counted = self._seconds.setdefault(stage, {})
            for work, passed in parts.items():
                counted[work] = counted.get(work, 0.0) + passed

    @property
    def total(self) -> float:
        """All seconds so far."""
        self._count()
        return sum(sum(parts.values()) for parts in self._seconds.values()) + sum(self._unsampled.values())

    def seconds(self) -> dict[str, dict[str, float]]:
        """Seconds by stage and by kind of work so far; kinds that took no time are absent."""
        self._count()
        counted = {
            stage: dict(self._seconds.get(stage, {})) for stage in {**self._seconds, **self._unsampled}
        }
        for stage, unsampled in self._unsampled.items():
            sampled = self._sampled.get(stage) or {"rest": 1.0}
            total = sum(sampled.values())
            for work, part in sampled.items():
                counted[stage][work] = counted[stage].get(work, 0.0) + unsampled * part / total
        return counted

    def enter(self, stage: str) -> None:
        """Begin a stage."""
        self._count()
        self._stage = stage

    @contextmanager
    def step(self, number: int) -> Iterator[None]:
        """Mark a training step, by its number in the stage."""
        self._count()
        self._in_step = True
        self._samples = self._synchronize is None or number % SAMPLE_INTERVAL == FIRST_SAMPLE
        self._wait()
        try:
            yield
        finally:
            self._wait()
            self._count()
            self._in_step, self._samples = False, self._synchronize is None

    def begin(self, mark: Mark) -> Mark:
        """Begin another kind of work; see `timed`. Returns the mark of the previous one, for `restore`."""
        before = self._mark
        if not before.undivided:
            if mark.undivided or self._samples:
                self._wait(always=mark.undivided)
                self._count()
            self._mark = mark
        return before

    def restore(self, before: Mark) -> None:
        """Return to the kind of work whose mark `begin` returned."""
        if before == self._mark:
            return
        if self._mark.undivided or self._samples:
            self._wait(always=self._mark.undivided)
            self._count()
        self._mark = before

    def _wait(self, always: bool = False) -> None:
        if self._synchronize is not None and (always or self._samples):
            self._synchronize()

    def _count(self) -> None:
        """Attribute the time since the last call to the current kind of work."""
        now = self._now()
        passed, self._since = now - self._since, now
        if self._in_step and not self._mark.undivided and not self._samples:
            self._unsampled[self._stage] = self._unsampled.get(self._stage, 0.0) + passed
            return
        targets = [self._seconds]
        if self._in_step and not self._mark.undivided and self._synchronize is not None:
            targets.append(self._sampled)
        for seconds in targets:
            parts = seconds.setdefault(self._stage, {})
            parts[self._mark.work] = parts.get(self._mark.work, 0.0) + passed


_ledger: Ledger | None = None


@contextmanager
def recording(ledger: Ledger) -> Iterator[Ledger]:
    """Make a ledger record all work in the context. Only one ledger of a process records at a time."""
    global _ledger
    before, _ledger = _ledger, ledger
    try:
        yield ledger
    finally:
        _ledger = before


class _Interrupted(NamedTuple):
    """The work that a `timed` context interrupts, and the ledger that counts it."""

    ledger: Ledger
    mark: Mark


class timed(ContextDecorator):
    """Mark the kind of work in a context, or in a decorated function, for the current ledger, if any.

    Args:
        work: the kind of work.
        undivided: whether all work within the context counts as `work`, as in a fit of the light that traces
            rays. The ledger then always waits for the device, since such work is rare and not part of every
            step.
    """

    def __init__(self, work: Work, undivided: bool = False) -> None:
        self._mark = Mark(work, undivided)
        self._before: list[_Interrupted | None] = []

    def __enter__(self) -> None:
        self._before.append(None if _ledger is None else _Interrupted(_ledger, _ledger.begin(self._mark)))

    def __exit__(self, *_: object) -> None:
        before = self._before.pop()
        if before is not None:
            before.ledger.restore(before.mark)
