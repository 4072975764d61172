"""A reader under test, and a picture to write."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import numpy as np

__all__ = ["SIZE", "Reader", "picture"]

SIZE = (18, 24)


@dataclass(frozen=True)
class Reader:
    """A reader under test.

    Attributes:
        make: writes whole files into a folder and returns those that are to be damaged, one at a time.
        read: reads what was made, where one file, which is given too, is damaged; raises what it raises, and
            an `AssertionError` where the value is one that it must not return.
        share: of the inputs that a cheap reader gets; those that cost milliseconds get fewer.
    """

    make: Callable[[Path], list[Path]]
    read: Callable[[Path, Path], object]
    share: float = 1.0


def picture(channels: int, kind: type = np.float32) -> np.ndarray:
    """Random values, a part of them constant."""
    values = np.random.default_rng(0).random((*SIZE, channels))
    values[:9] = 0.25  # constant parts are compressed in another way than noise
    return (values * (255 if kind is np.uint8 else 65_535 if kind is np.uint16 else 1)).astype(kind)
