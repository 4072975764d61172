"""Uniform draws among the pixels that are valid, without a list of them."""

from __future__ import annotations

import torch
from jaxtyping import Bool, Int
from torch import Tensor

__all__ = ["ValidPixels"]

BLOCK = 256


class ValidPixels:
    """The numbers of the valid ones among P pixels, drawn uniformly and independently.

    The k-th valid pixel is looked up: its block by the running count of valid pixels, then its place in the block. That
    takes one byte a pixel and no host–device synchronisation, and where all pixels are valid the k-th is k.

    Args:
        valid: which pixels can be drawn; at least one. Kept as `valid`, in place of the argument.
    """

    def __init__(self, valid: Bool[Tensor, " P"]) -> None:
        self._blocks = torch.nn.functional.pad(valid, (0, -len(valid) % BLOCK)).view(-1, BLOCK)
        self.valid = self._blocks.view(-1)[: len(valid)]
        self._before = torch.nn.functional.pad(self._blocks.sum(1).cumsum(0), (1, 0))
        self.count = int(self._before[-1])
        self.all = self.count == len(valid)

    def draw(self, count: int) -> Int[Tensor, " count"]:
        """`count` numbers of valid pixels, by torch's global generator."""
        kth = torch.randint(self.count, (count,), device=self._blocks.device)
        return kth if self.all else self.find(kth)

    def find(self, kth: Int[Tensor, " N"]) -> Int[Tensor, " N"]:
        """The number of the k-th valid pixel, k from 0 to `count` − 1."""
        block = torch.searchsorted(self._before, kth, right=True) - 1
        running = self._blocks[block].cumsum(1)
        within = torch.searchsorted(running, (kth - self._before[block] + 1)[:, None])
        return block * BLOCK + within[:, 0]
