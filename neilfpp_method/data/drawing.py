"""Which pixels a step learns from: with masks, most of them on the object or near its outline.

What a pixel far off the object shows is known after a few steps, so a step that draws uniformly from pictures
of one object under a sky spends most of its rays on nothing. Where the object is known, `NEAR_SHARE` of a
step's pixels are drawn from those on it or near its outline, and the rest from all others; within each of the
two every pixel is as likely as any other. Where nothing is known of the object, all valid pixels are alike.

The loss stays a plain mean over the pixels that are drawn: it is weighted towards the object on purpose, and
no importance weights take that back.
"""

from __future__ import annotations

import cv2
import numpy as np
import torch
from jaxtyping import Bool, Int, UInt8
from torch import Tensor

__all__ = ["BLOCK", "KNOWN", "MASK", "NEAR", "VALID", "PixelDraws", "PixelSet", "near_object"]

VALID, MASK, KNOWN, NEAR = 1, 2, 4, 8
"""Bits of a pixel: valid; on the object; whether that is known; on the object or near its outline."""
NEAR_SHARE = 0.85
"""Share of a step's pixels that are on the object or near its outline, where masks tell it."""
NEAR_DISTANCE = 0.08
"""How far from the object a pixel is near it: this share of the longer side of the image."""
SMALL_SIDE = 256
"""Longest side, pixels, at which nearness is decided."""
BLOCK = 1024
"""Pixels of a block, whose chosen pixels are counted; pixel planes are padded to whole blocks."""
COUNTED = 2**14
"""Blocks that are counted together."""


class PixelSet:
    """The numbers of the pixels with certain bits among P, drawn uniformly and independently.

    The k-th such pixel is looked up: its block by the running count, then its place in the block. That takes
    a byte a pixel, wherever that byte is, and 8 bytes a block in memory.

    Args:
        bits: of all pixels; a whole number of blocks, 0 in what is padded.
        of: the bits that are looked at.
        are: what they are.
    """

    def __init__(self, bits: UInt8[np.ndarray, " P"], of: int, are: int) -> None:
        self._bits, self._of, self._are = bits.reshape(-1, BLOCK), of, are
        counts = [self._chosen(slice(k, k + COUNTED)).sum(axis=1) for k in range(0, len(self._bits), COUNTED)]
        self._before = np.concatenate([[0], np.concatenate(counts).cumsum()])
        self.count = int(self._before[-1])

    def _chosen(self, blocks: slice | Int[np.ndarray, " N"]) -> Bool[np.ndarray, "N B"]:
        return (self._bits[blocks] & self._of) == self._are

    def draw(self, count: int) -> Int[Tensor, " count"]:
        """`count` numbers, by torch's global generator on the CPU."""
        return self.find(torch.randint(self.count, (count,)))

    def find(self, kth: Int[Tensor, " N"]) -> Int[Tensor, " N"]:
        """The number of the k-th pixel of the set, k from 0 to `count` − 1."""
        wanted = kth.numpy()
        block = np.searchsorted(self._before, wanted, side="right") - 1
        running = self._chosen(block).cumsum(axis=1, dtype=np.int32)
        within = (running < (wanted - self._before[block] + 1)[:, None]).sum(axis=1)
        return torch.from_numpy(block * BLOCK + within)


class PixelDraws:
    """Draws of a step's pixels.

    Args:
        bits: of all pixels, as for `PixelSet`. Where a pixel has `NEAR`, the object is known.
        total: number of pixels without the padding.
    """

    def __init__(self, bits: UInt8[np.ndarray, " P"], total: int) -> None:
        self.valid = PixelSet(bits, VALID, VALID)
        self._left_out = torch.zeros(0, dtype=torch.long)
        near = PixelSet(bits, VALID | NEAR, VALID | NEAR)
        self._all = self.valid.count == total
        # Nearly everything may be near the object already, and none of it the rest.
        self._parts = None
        if 0 < near.count < NEAR_SHARE * self.valid.count:
            self._parts = (near, PixelSet(bits, VALID | NEAR, VALID))

    def leave_out(self, numbers: Int[Tensor, " N"]) -> None:
        """Draw these pixels no more; they must be few among those near the object and among the rest."""
        self._left_out = numbers

    def draw(self, count: int) -> Int[Tensor, " count"]:
        """`count` indices of valid pixels, with repetition, from torch's global CPU generator; unordered."""
        if self._parts is None:
            return self._of(self.valid, count)
        near, rest = self._parts
        first = round(NEAR_SHARE * count)
        drawn = torch.cat([self._of(near, first), self._of(rest, count - first)])
        # A step may use the first pixels alone.
        return drawn[torch.randperm(count)]

    def _of(self, pixels: PixelSet, count: int) -> Int[Tensor, " count"]:
        """Numbers from one set. Those that are left out are drawn again: all others stay equally likely."""
        drawn = self._any_of(pixels, count)
        while len(again := torch.nonzero(torch.isin(drawn, self._left_out))[:, 0]):
            drawn[again] = self._any_of(pixels, len(again))
        return drawn

    def _any_of(self, pixels: PixelSet, count: int) -> Int[Tensor, " count"]:
        everything = self._all and pixels is self.valid  # needs no look-up
        return torch.randint(pixels.count, (count,)) if everything else pixels.draw(count)


def near_object(mask: Bool[np.ndarray, "H W"]) -> Bool[np.ndarray, "H W"]:
    """Pixels on the object or within `NEAR_DISTANCE` of it, to a pixel of a picture of `SMALL_SIDE`.

    >>> mask = np.zeros((100, 100), bool)
    >>> mask[50, 50] = True
    >>> near_object(mask).sum(axis=0).max()
    17
    """
    height, width = mask.shape
    share = min(1.0, SMALL_SIDE / max(height, width))
    size = (max(1, round(width * share)), max(1, round(height * share)))
    small = cv2.resize(mask.astype(np.float32), size, interpolation=cv2.INTER_AREA) > 0
    reach = round(NEAR_DISTANCE * max(size))
    disc = cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (2 * reach + 1, 2 * reach + 1))
    dilated = cv2.dilate(small.astype(np.uint8), disc)
    return mask | (cv2.resize(dilated, (width, height), interpolation=cv2.INTER_NEAREST) > 0)
