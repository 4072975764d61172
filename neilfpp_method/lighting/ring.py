"""A ring buffer of rows of numbers."""

from __future__ import annotations

import torch
from jaxtyping import Float
from torch import Tensor, nn

__all__ = ["Ring"]


class Ring(nn.Module):
    """A ring buffer that keeps the newest rows. Its state is part of a checkpoint.

    Args:
        capacity: maximum number of rows.
        width: numbers per row.
    """

    def __init__(self, capacity: int, width: int) -> None:
        super().__init__()
        self.register_buffer("rows", torch.zeros(capacity, width))
        self.filled = 0
        self.next = 0

    @property
    def capacity(self) -> int:
        """The maximum number of rows."""
        return len(self.rows)

    @property
    def full(self) -> bool:
        """Whether the next row that is stored replaces the oldest one."""
        return self.filled == self.capacity

    @torch.no_grad()
    def keep(self, rows: Float[Tensor, "N W"]) -> None:
        """Store rows; if there are more than the capacity, only the first ones."""
        rows = rows[: self.capacity].to(self.rows.dtype)
        slots = torch.arange(self.next, self.next + len(rows), device=rows.device) % self.capacity
        self.rows[slots] = rows
        self.next = (self.next + len(rows)) % self.capacity
        self.filled = min(self.filled + len(rows), self.capacity)

    def kept(self) -> Float[Tensor, "K W"]:
        """All stored rows, in no particular order."""
        return self.rows[: self.filled]

    def draw(self, count: int) -> Float[Tensor, "K W"]:
        """Draw stored rows at random with replacement, at most as many as are stored."""
        numbers = torch.randint(max(1, self.filled), (min(count, self.filled),), device=self.rows.device)
        return self.rows[numbers]

    def get_extra_state(self) -> dict[str, int]:
        """The counters, for a checkpoint."""
        return {"filled": self.filled, "next": self.next}

    def set_extra_state(self, state: dict[str, int]) -> None:
        """Restore the counters from a checkpoint."""
        self.filled, self.next = state["filled"], state["next"]
