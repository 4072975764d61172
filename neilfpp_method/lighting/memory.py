"""What light is fitted to: surface points that training has seen, a share of every step's."""

from __future__ import annotations

import math
from dataclasses import dataclass

import torch
from jaxtyping import Float
from torch import Tensor, nn

from neilfpp_method.lighting.ring import Ring
from neilfpp_method.structures import Indexable

__all__ = ["Observed", "SurfaceMemory"]

PATIENCE = 4
"""Steps that the first fit waits for more points."""


@dataclass(frozen=True)
class Observed(Indexable):
    """Surface points and what an image holds of each: `pixel` in the capture's response, `wo` towards the camera."""

    position: Float[Tensor, "N 3"]
    normal: Float[Tensor, "N 3"]
    wo: Float[Tensor, "N 3"]
    pixel: Float[Tensor, "N 3"]


class SurfaceMemory(nn.Module):
    """The newest points of all images, and when to fit to them next: for the first time when the memory is full, or after a few
    steps, as surfaces start to learn under a light that nobody has fitted. It is part of a checkpoint.

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
        return self.points.full or (self.points.filled > 0 and self.waited >= PATIENCE)

    @torch.no_grad()
    def remember(self, seen: Observed) -> None:
        """Keep some rows, in the place of the oldest; before the first fit all of them."""
        self.waited += self.age is None
        share = len(seen) if self.age is None else math.ceil(self.points.capacity / self.every)
        self.points.keep(torch.cat((seen.position, seen.normal, seen.wo, seen.pixel), -1)[:share])
        if self.age is not None:
            self.age += 1

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
