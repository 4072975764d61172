"""Rows of numbers that are remembered: the newest, in the place of the oldest."""

from __future__ import annotations

import torch
from jaxtyping import Float
from torch import Tensor, nn

__all__ = ["Ring"]


class Ring(nn.Module):
    """The newest rows, part of a checkpoint.

    Args:
        capacity: how many rows are kept.
        width: numbers in a row.
    """

    def __init__(self, capacity: int, width: int) -> None:
        super().__init__()
        self.register_buffer("rows", torch.zeros(capacity, width))
        self.filled = 0
        self.next = 0

    @property
    def capacity(self) -> int:
        """How many rows are kept."""
        return len(self.rows)

    @property
    def full(self) -> bool:
        """Whether what is kept next takes the place of something."""
        return self.filled == self.capacity

    @torch.no_grad()
    def keep(self, rows: Float[Tensor, "N W"]) -> None:
        """Keep rows, the first ones where there are more than fit."""
        rows = rows[: self.capacity].to(self.rows.dtype)
        slots = torch.arange(self.next, self.next + len(rows), device=rows.device) % self.capacity
        self.rows[slots] = rows
        self.next = (self.next + len(rows)) % self.capacity
        self.filled = min(self.filled + len(rows), self.capacity)

    def kept(self) -> Float[Tensor, "K W"]:
        """Everything that is remembered, in no order."""
        return self.rows[: self.filled]

    def draw(self, count: int) -> Float[Tensor, "K W"]:
        """Some of it at random, each draw for itself; at most as many as are remembered."""
        at = torch.randint(max(1, self.filled), (min(count, self.filled),), device=self.rows.device)
        return self.rows[at]

    def get_extra_state(self) -> dict[str, int]:
        """Where the ring stands, for checkpoints."""
        return {"filled": self.filled, "next": self.next}

    def set_extra_state(self, state: dict[str, int]) -> None:
        """The inverse of `get_extra_state`."""
        self.filled, self.next = state["filled"], state["next"]
