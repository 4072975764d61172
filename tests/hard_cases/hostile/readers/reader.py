"""A reader under test, and what several modules of readers use."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import cache
from pathlib import Path

import numpy as np

from neilfpp_method.data.capture import Capture, load_capture

__all__ = ["SIZE", "Reader", "capture_beside", "picture"]

SIZE = (18, 24)


@dataclass(frozen=True)
class Reader:
    """A reader under test.

    Attributes:
        make: writes valid files into a folder and returns those that are to be damaged, one at a time.
        read: reads the files in the folder, of which the one at the given path is damaged. Errors of the
            reader are passed on; an `AssertionError` means that it returned a value that it must not return.
        share: number of inputs of this reader, as a share of the number for a cheap reader. Readers that take
            milliseconds get fewer.
    """

    make: Callable[[Path], list[Path]]
    read: Callable[[Path, Path], object]
    share: float = 1.0


def picture(channels: int, kind: type = np.float32) -> np.ndarray:
    """Random values, a part of them constant."""
    values = np.random.default_rng(0).random((*SIZE, channels))
    values[:9] = 0.25  # constant parts are compressed in another way than noise
    return (values * (255 if kind is np.uint8 else 65_535 if kind is np.uint16 else 1)).astype(kind)


@cache
def capture_beside(folder: Path) -> Capture:
    """The undamaged capture in a folder, which is read once."""
    return load_capture(folder)
