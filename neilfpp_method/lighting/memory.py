"""The surface points that light is fitted to: a share of every training step's."""

from __future__ import annotations

import math

import torch
from torch import nn

from neilfpp_method.lighting.ring import Ring
from neilfpp_method.structures import Observed

__all__ = ["SurfaceMemory"]

FIRST_WAIT = 4
"""Steps before the first fit, even if the memory is not full: until then the light is a guess."""


class SurfaceMemory(nn.Module):
    """The newest surface points of all images, and when to fit to them next: for the first time when the
    memory is full, or after a few steps. It is part of a checkpoint.

    Args:
        capacity: how many points are kept.
        every: steps between two fits.
    """

    def __init__(self, capacity: int, every: int) -> None:
        super().__init__()
        self.every = every
        self.points = Ring(capacity, 12)
        self.waited = 0
        self.age: int | None = None

    @property
    def due(self) -> bool:
        """Whether it is time to fit: `every` steps after each fit, and soon for the first time."""
        if self.age is not None:
            return self.age >= self.every
        return self.points.full or (self.points.filled > 0 and self.waited >= FIRST_WAIT)

    @torch.no_grad()
    def remember(self, observed: Observed) -> None:
        """Keep some rows, in the place of the oldest; before the first fit all of them."""
        self.waited += self.age is None
        share = len(observed) if self.age is None else math.ceil(self.points.capacity / self.every)
        rows = torch.cat((observed.position, observed.normal, observed.wo, observed.pixel), -1)
        self.points.keep(rows[:share])
        if self.age is not None:
            self.age += 1

    def wait(self) -> None:
        """Let the first fit be due after `every` steps, as the light that there is needs none before."""
        self.age = 0

    def recall(self) -> Observed:
        """Everything that is remembered, for a fit that is done now."""
        self.age = 0
        return Observed(*self.points.kept().split(3, -1))

    def get_extra_state(self) -> dict[str, int | None]:
        """Where the memory stands, for checkpoints."""
        return {"age": self.age, "waited": self.waited}

    def set_extra_state(self, state: dict[str, int | None]) -> None:
        """The inverse of `get_extra_state`."""
        self.age, self.waited = state["age"], state["waited"]
