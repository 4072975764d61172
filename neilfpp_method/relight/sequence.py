"""Quasi-random numbers in [0, 1) for paths: a Sobol sequence with a random shift per pixel and dimension.

The samples of a pixel cover each pair of dimensions evenly, which reduces noise faster than independent
random numbers. The random shift (Cranley and Patterson 1976) makes each estimate unbiased, and the errors of
neighbouring pixels independent.
"""

from __future__ import annotations

from dataclasses import dataclass

import torch
from jaxtyping import Float, Int
from torch import Tensor
from torch.quasirandom import SobolEngine

__all__ = ["Numbers", "SobolSequence"]

WORD = 0xFFFFFFFF
"""Mask of 32 bits. The product of a word and a multiplier below 2³¹ fits into int64."""


@dataclass(frozen=True)
class Numbers:
    """The numbers of N paths.

    Attributes:
        points: a block of the sequence; rows are samples, columns are dimensions.
        sample: row of `points` for each path.
        pixel: pixel of each path, which determines its shift.
        seed: seed of the shifts.
    """

    points: Float[Tensor, "K D"]
    sample: Int[Tensor, " N"]
    pixel: Int[Tensor, " N"]
    seed: int

    def of(self, paths: Int[Tensor, " M"]) -> Numbers:
        """Select some of the paths."""
        return Numbers(self.points, self.sample[paths], self.pixel[paths], self.seed)

    def at(self, paths: Int[Tensor, " M"], first: int, count: int) -> Float[Tensor, "M C"]:
        """Return dimensions first … first + count − 1 of some of the paths."""
        dimension = torch.arange(first, first + count, device=self.points.device)
        word = _hashed(_hashed(_hashed(self.pixel[paths][:, None]) ^ dimension) ^ self.seed)
        shift = word.to(self.points.dtype) / (WORD + 1)
        shifted = self.points[self.sample[paths], first : first + count] + shift
        return (shifted - shifted.floor()).clamp_max(1 - 2**-24)


class SobolSequence:
    """The sequence of one image, generated in blocks of samples.

    Args:
        dimensions: number of dimensions, the largest number of values that a path uses.
        seed: the same seed gives the same numbers, independent of the sizes of the blocks.
    """

    def __init__(self, dimensions: int, seed: int) -> None:
        self._engine = SobolEngine(dimensions, scramble=True, seed=seed)
        self._seed = seed & WORD

    def next(self, samples: int, pixels: int, device: torch.device | str = "cpu") -> Numbers:
        """Generate the next samples of each pixel; path s · pixels + p is sample s of pixel p."""
        points = self._engine.draw(samples).to(device)
        path = torch.arange(samples * pixels, device=device)
        return Numbers(points, path // pixels, path % pixels, self._seed)


def _hashed(word: Int[Tensor, "*B"]) -> Int[Tensor, "*B"]:
    """Mix the 32 bits of a word (a multiply-xorshift hash)."""
    word = ((word ^ (word >> 16)) * 0x45D9F3B) & WORD
    word = ((word ^ (word >> 16)) * 0x45D9F3B) & WORD
    return word ^ (word >> 16)
