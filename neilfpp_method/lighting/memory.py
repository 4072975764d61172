"""A memory of surface points from recent training steps, to which the light is fitted."""

from __future__ import annotations

import math

import torch
from torch import nn

from neilfpp_method.lighting.ring import Ring
from neilfpp_method.structures import Observed

__all__ = ["SurfaceMemory"]

FIRST_WAIT = 4
"""Steps before the first fit even if the memory is not full yet: until then the light has its initial
value.
"""


class SurfaceMemory(nn.Module):
    """A ring buffer of surface points, and the schedule of the fits. Its state is part of a checkpoint.

    The first fit is due when the buffer is full or after `FIRST_WAIT` steps, the following ones every
    `every` steps.

    Args:
        capacity: number of points in the buffer.
        every: number of steps between two fits.

    Attributes:
        points: the buffer.
        waited: number of steps before the first fit.
        age: number of steps since the last fit; None before the first.
    """

    def __init__(self, capacity: int, every: int) -> None:
        super().__init__()
        self.every = every
        self.points = Ring(capacity, Observed.WIDTH)
        self.waited = 0
        self.age: int | None = None

    @property
    def due(self) -> bool:
        """Whether a fit is due."""
        if self.age is not None:
            return self.age >= self.every
        return self.points.full or (self.points.filled > 0 and self.waited >= FIRST_WAIT)

    @torch.no_grad()
    def remember(self, observed: Observed) -> None:
        """Add the surface points of a step to the buffer, in place of the oldest.

        Before the first fit all of them are added; after it as many as replace the whole buffer once
        between two fits.
        """
        self.waited += self.age is None
        share = len(observed) if self.age is None else math.ceil(self.points.capacity / self.every)
        self.points.keep(observed.rows()[:share])
        if self.age is not None:
            self.age += 1

    def wait(self) -> None:
        """Postpone the first fit by `every` steps, because the current light is already an estimate."""
        self.age = 0

    def recall(self) -> Observed:
        """All remembered points, for a fit; the count of steps to the next fit restarts."""
        self.age = 0
        return Observed.of_rows(self.points.kept())

    def get_extra_state(self) -> dict[str, int | None]:
        """The counters, for a checkpoint."""
        return {"age": self.age, "waited": self.waited}

    def set_extra_state(self, state: dict[str, int | None]) -> None:
        """Restore the counters from a checkpoint."""
        self.age, self.waited = state["age"], state["waited"]
