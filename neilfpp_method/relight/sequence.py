"""Numbers in [0, 1) for paths: a Sobol sequence, randomly shifted for every pixel and dimension.

The samples of a pixel cover the square of each pair of dimensions evenly, which brings down noise faster than
independent numbers do; the shift (Cranley and Patterson 1976) makes each estimate unbiased and the errors of
neighbours independent.
"""

from __future__ import annotations

from dataclasses import dataclass

import torch
from jaxtyping import Float, Int
from torch import Tensor
from torch.quasirandom import SobolEngine

__all__ = ["Numbers", "Sequence"]

WORD = 0xFFFFFFFF
"""32 bits: products of two words and a constant below 2³¹ stay within int64."""


@dataclass(frozen=True)
class Numbers:
    """The numbers of N paths.

    Attributes:
        points: a block of the sequence, one row for each sample, one column for each dimension.
        sample: the row of each path.
        pixel: whose shift each path has.
        seed: of the shifts.
    """

    points: Float[Tensor, "K D"]
    sample: Int[Tensor, " N"]
    pixel: Int[Tensor, " N"]
    seed: int

    def of(self, paths: Int[Tensor, " M"]) -> Numbers:
        """The numbers of some of the paths."""
        return Numbers(self.points, self.sample[paths], self.pixel[paths], self.seed)

    def at(self, paths: Int[Tensor, " M"], first: int, count: int) -> Float[Tensor, "M C"]:
        """Dimensions first … first + count − 1 of some of the paths."""
        dimension = torch.arange(first, first + count, device=self.points.device)
        shift = _hashed(_hashed(_hashed(self.pixel[paths][:, None]) ^ dimension) ^ self.seed)
        moved = self.points[self.sample[paths], first : first + count] + shift.to(self.points.dtype) / (
            WORD + 1
        )
        return (moved - moved.floor()).clamp_max(1 - 2**-24)


class Sequence:
    """The sequence of one picture, handed out in blocks of samples.

    Args:
        dimensions: numbers that a path may use.
        seed: the same seed gives the same numbers, whatever the blocks.
    """

    def __init__(self, dimensions: int, seed: int) -> None:
        self._engine = SobolEngine(dimensions, scramble=True, seed=seed)
        self._seed = seed & WORD

    def next(self, samples: int, pixels: int, device: torch.device | str = "cpu") -> Numbers:
        """The next `samples` samples of each pixel: path s · pixels + p is sample s of pixel p."""
        points = self._engine.draw(samples).to(device)
        path = torch.arange(samples * pixels, device=device)
        return Numbers(points, path // pixels, path % pixels, self._seed)


def _hashed(word: Int[Tensor, "*B"]) -> Int[Tensor, "*B"]:
    """A word with its 32 bits mixed (a multiply-xorshift hash)."""
    word = ((word ^ (word >> 16)) * 0x45D9F3B) & WORD
    word = ((word ^ (word >> 16)) * 0x45D9F3B) & WORD
    return word ^ (word >> 16)
