"""How colours are kept: in as few bits as hold what the files say.

8-bit images keep their bytes, so they come back to the bit. 16-bit images, and display values that were
averaged, take 16 bits. Radiance is kept in half precision (11 bits of mantissa), with a power of two for each
view that brings its brightest pixel near the top of the range; where a view's range is wider than that of
half, all views are kept in single precision.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float, Float32, Shaped

__all__ = ["BYTES", "ENCODINGS", "Encoded", "Encoding", "encodings_for"]

MAX_VALUE = 32_768.0
"""Largest encoded value of a view in half precision, which ends at 65 504."""
MIN_MEDIAN = 2.0**-4
"""Least median of a view in half precision: a thousandth of it still has 11 bits (they end at 2⁻¹⁴)."""
MEDIAN_SAMPLES = 2**20
"""Values of a view that its median is taken of."""


@dataclass(frozen=True)
class Encoded:
    """Codes of a view; a colour is `decode` of its code, divided by `scale`."""

    codes: Shaped[np.ndarray, "H W 3"]
    scale: float


@dataclass(frozen=True)
class Encoding:
    """One way to keep colours.

    Attributes:
        name: as the store's description has it.
        dtype: of a channel.
        encode: codes of colours that are finite and not negative; none where too much of them would be lost.
    """

    name: str
    dtype: np.dtype
    encode: Callable[[Float32[np.ndarray, "H W 3"]], Encoded | None]

    def decode(
        self, codes: Shaped[np.ndarray, "*shape 3"], scale: float | Float[np.ndarray, "*shape"]
    ) -> Float32[np.ndarray, "*shape 3"]:
        """Colours from codes; `scale` is that of the codes' views."""
        if np.issubdtype(self.dtype, np.integer):
            return codes.astype(np.float32) / np.float32(np.iinfo(self.dtype).max)
        return codes.astype(np.float32) / np.asarray(scale, np.float32)[..., None]


def _levels(bits: int) -> Encoding:
    dtype = np.dtype(f"uint{bits}")
    full = np.float32(np.iinfo(dtype).max)

    def encode(color: Float32[np.ndarray, "H W 3"]) -> Encoded | None:
        codes = np.rint(color * full)
        # Of 8 bits, bytes alone will do; 16 bits stand for whatever display value lies next to them.
        lost = 1e-6 if bits == 8 else 0.51 / full
        if codes.max(initial=0) > full or np.abs(codes / full - color).max(initial=0) > lost:
            return None
        return Encoded(codes.astype(dtype), 1.0)

    return Encoding(f"uint{bits}", dtype, encode)


def _half(color: Float32[np.ndarray, "H W 3"]) -> Encoded | None:
    brightest = float(color.max(initial=0.0))
    scale = 2.0 ** math.floor(math.log2(MAX_VALUE / brightest)) if brightest > 0 else 1.0
    some = color.reshape(-1)[:: -(-color.size // MEDIAN_SAMPLES)]
    lit = some[some > 0]
    if len(lit) and (not np.isfinite(np.float32(scale)) or float(np.median(lit)) * scale < MIN_MEDIAN):
        return None
    return Encoded((color * np.float32(scale)).astype(np.float16), scale)


HALF = Encoding("float16", np.dtype(np.float16), _half)
FLOAT = Encoding("float32", np.dtype(np.float32), lambda color: Encoded(color, 1.0))
BYTES, WORDS = _levels(8), _levels(16)
ENCODINGS = {encoding.name: encoding for encoding in (BYTES, WORDS, HALF, FLOAT)}


def encodings_for(hdr: bool, exact: bool = False) -> tuple[Encoding, ...]:
    """The encodings of a capture, from the smallest to one that holds everything; `exact`: that one alone."""
    if exact:
        return (FLOAT,)
    return (HALF, FLOAT) if hdr else (BYTES, WORDS, FLOAT)
