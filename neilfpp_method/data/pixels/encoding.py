"""Encodings of stored colours, with as few bits as the files need.

8-bit images are stored as bytes, without loss. 16-bit images, and display values that were averaged, take 16
bits. Radiance is stored in half precision (11 bits of mantissa), multiplied by a power of two for each view
that brings its brightest pixel near the top of the range. If the range of a view is wider than that of half
precision, all views are stored in single precision.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float, Float32, Shaped

__all__ = ["BYTES", "ENCODINGS", "EncodedView", "Encoding", "encodings_for"]

MAX_VALUE = 32_768.0
"""Largest encoded value of a view in half precision, whose largest number is 65 504."""
MIN_MEDIAN = 2.0**-4
"""Smallest encoded median of a view in half precision: a thousandth of it is a normal number (above 2⁻¹⁴)."""
MEDIAN_SAMPLES = 2**20
"""Number of values of a view from which its median is computed."""


@dataclass(frozen=True)
class EncodedView:
    """Codes of a view, and its factor `scale`, by which decoded values are divided."""

    codes: Shaped[np.ndarray, "H W 3"]
    scale: float


@dataclass(frozen=True)
class Encoding:
    """An encoding of colours.

    Attributes:
        name: its name in `store.json`.
        dtype: type of a channel.
        encode: function from finite, non-negative colours to codes; returns None if the loss were too large.
    """

    name: str
    dtype: np.dtype
    encode: Callable[[Float32[np.ndarray, "H W 3"]], EncodedView | None]

    def decode(
        self, codes: Shaped[np.ndarray, "*shape 3"], scale: float | Float[np.ndarray, "*shape"]
    ) -> Float32[np.ndarray, "*shape 3"]:
        """Return the colours of codes; `scale` is the factor of the view of each code."""
        if np.issubdtype(self.dtype, np.integer):
            return codes.astype(np.float32) / np.float32(np.iinfo(self.dtype).max)
        return codes.astype(np.float32) / np.asarray(scale, np.float32)[..., None]


def _levels(bits: int) -> Encoding:
    dtype = np.dtype(f"uint{bits}")
    full = np.float32(np.iinfo(dtype).max)

    def encode(color: Float32[np.ndarray, "H W 3"]) -> EncodedView | None:
        codes = np.rint(color * full)
        # 8 bits must be exact; 16 bits may round to the nearest level.
        lost = 1e-6 if bits == 8 else 0.51 / full
        if codes.max(initial=0) > full or np.abs(codes / full - color).max(initial=0) > lost:
            return None
        return EncodedView(codes.astype(dtype), 1.0)

    return Encoding(f"uint{bits}", dtype, encode)


def _half(color: Float32[np.ndarray, "H W 3"]) -> EncodedView | None:
    brightest = float(color.max(initial=0.0))
    scale = 2.0 ** math.floor(math.log2(MAX_VALUE / brightest)) if brightest > 0 else 1.0
    some = color.reshape(-1)[:: -(-color.size // MEDIAN_SAMPLES)]
    positive = some[some > 0]
    too_dark = len(positive) > 0 and float(np.median(positive)) * scale < MIN_MEDIAN
    if too_dark or scale > float(np.finfo(np.float32).max):
        return None
    return EncodedView((color * np.float32(scale)).astype(np.float16), scale)


HALF = Encoding("float16", np.dtype(np.float16), _half)
FLOAT = Encoding("float32", np.dtype(np.float32), lambda color: EncodedView(color, 1.0))
BYTES, WORDS = _levels(8), _levels(16)
ENCODINGS = {encoding.name: encoding for encoding in (BYTES, WORDS, HALF, FLOAT)}


def encodings_for(hdr: bool, exact: bool = False) -> tuple[Encoding, ...]:
    """Return the encodings to try for a capture, smallest first; `exact`: single precision only."""
    if exact:
        return (FLOAT,)
    return (HALF, FLOAT) if hdr else (BYTES, WORDS, FLOAT)
