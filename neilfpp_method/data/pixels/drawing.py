"""Random choice of the pixels of a training step: with masks, most of them on the object or near its outline.

The background far from the object is learned in a few steps, so uniform sampling would spend most rays on it.
If the object is known, `NEAR_SHARE` of the pixels of a step are drawn from those on the object or near its
outline, and the rest from all other pixels, both uniformly. Otherwise all valid pixels are equally likely.

The loss is the plain mean over the drawn pixels. It is weighted towards the object on purpose; there are no
importance weights to compensate for it.
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
"""Share of the pixels of a step that are on the object or near its outline, if the object is known."""
NEAR_DISTANCE = 0.08
"""Largest distance of a near pixel from the object, as a share of the longer side of the image."""
SMALL_SIDE = 256
"""Longest side of the reduced mask in which near pixels are computed, in pixels."""
BLOCK = 1024
"""Number of pixels of a block, the unit of the counts of `PixelSet`; arrays are padded to whole blocks."""
BLOCKS_AT_ONCE = 2**14
"""Number of blocks that are counted at once; bounds the memory."""


class PixelSet:
    """The indices of the pixels with certain bits, for uniform and independent draws.

    The k-th such pixel is found by its block, from cumulative counts, and then within the block. This takes 8
    bytes of memory per block beside the array of bits, which may be a memory-mapped file.

    Args:
        bits: the bits of all pixels; a whole number of blocks, 0 in the padding.
        having: the bits that a pixel of the set has, such as `VALID | MASK`.
        lacking: the bits that it does not have.
    """

    def __init__(self, bits: UInt8[np.ndarray, " P"], having: int, lacking: int = 0) -> None:
        self._bits, self._having, self._compared = bits.reshape(-1, BLOCK), having, having | lacking
        counts = [
            self._chosen(slice(k, k + BLOCKS_AT_ONCE)).sum(axis=1)
            for k in range(0, len(self._bits), BLOCKS_AT_ONCE)
        ]
        self._before = np.concatenate([[0], np.concatenate(counts).cumsum()])
        self.count = int(self._before[-1])

    def _chosen(self, blocks: slice | Int[np.ndarray, " N"]) -> Bool[np.ndarray, "N B"]:
        return (self._bits[blocks] & self._compared) == self._having

    def draw(self, count: int) -> Int[Tensor, " count"]:
        """Draw `count` indices with torch's global generator on the CPU."""
        return self.find(torch.randint(self.count, (count,)))

    def find(self, kth: Int[Tensor, " N"]) -> Int[Tensor, " N"]:
        """Return the index of the k-th pixel of the set, k from 0 to `count` − 1."""
        wanted = kth.numpy()
        block = np.searchsorted(self._before, wanted, side="right") - 1
        running = self._chosen(block).cumsum(axis=1, dtype=np.int32)
        within = (running < (wanted - self._before[block] + 1)[:, None]).sum(axis=1)
        return torch.from_numpy(block * BLOCK + within)


class PixelDraws:
    """The distribution from which the pixels of a step are drawn.

    Args:
        bits: the bits of all pixels, as for `PixelSet`. If any pixel has `NEAR`, the object is known.
        total: number of pixels without the padding.
    """

    def __init__(self, bits: UInt8[np.ndarray, " P"], total: int) -> None:
        self.valid = PixelSet(bits, VALID)
        self._left_out = torch.zeros(0, dtype=torch.long)
        near = PixelSet(bits, VALID | NEAR)
        self._all_valid = self.valid.count == total
        # If nearly all pixels are near the object, the draws are uniform.
        self._parts = None
        if 0 < near.count < NEAR_SHARE * self.valid.count:
            self._parts = (near, PixelSet(bits, VALID, lacking=NEAR))

    def leave_out(self, numbers: Int[Tensor, " N"]) -> None:
        """Exclude pixels from all later draws; they must be few, near the object and elsewhere."""
        self._left_out = numbers

    def draw(self, count: int) -> Int[Tensor, " count"]:
        """Draw `count` indices of valid pixels, with repetition and in random order."""
        if self._parts is None:
            return self._draw_from(self.valid, count)
        near, rest = self._parts
        first = round(NEAR_SHARE * count)
        drawn = torch.cat([self._draw_from(near, first), self._draw_from(rest, count - first)])
        # Shuffled, because a step may use the first pixels only.
        return drawn[torch.randperm(count)]

    def _draw_from(self, pixels: PixelSet, count: int) -> Int[Tensor, " count"]:
        """Draw from one set; excluded pixels are drawn again, so that all others stay equally likely."""
        drawn = self._draw_any(pixels, count)
        while len(again := torch.nonzero(torch.isin(drawn, self._left_out))[:, 0]):
            drawn[again] = self._draw_any(pixels, len(again))
        return drawn

    def _draw_any(self, pixels: PixelSet, count: int) -> Int[Tensor, " count"]:
        """Draw from one set, also pixels that are excluded."""
        if self._all_valid and pixels is self.valid:
            # The k-th valid pixel is pixel k.
            return torch.randint(pixels.count, (count,))
        return pixels.draw(count)


def near_object(mask: Bool[np.ndarray, "H W"]) -> Bool[np.ndarray, "H W"]:
    """Return the pixels on the object or within `NEAR_DISTANCE` of it, computed on a reduced mask.

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
