"""What a training takes of memory, asked before it takes any."""

from __future__ import annotations

import math

from neilfpp_method.data.capture import Capture
from neilfpp_method.data.memory import check_memory
from neilfpp_method.data.scaling import file_size
from neilfpp_method.settings.types import NeilfConfig

__all__ = ["check_training_memory", "training_bytes"]

READING = 40
"""Bytes to a pixel of the largest file while it is decoded, made linear, averaged and encoded (benchmarks/memory.py)."""
COUNTS = 3 * 8 / 1024
"""Bytes to a pixel of all views: counts of three sets of pixels, by block."""
LOADED = 0.8e9
"""Bytes of a training that has loaded its libraries, and computes steps of the preset `fast`."""


def training_bytes(capture: Capture, config: NeilfConfig) -> int:
    """About how many bytes a training takes beside pages of files, which the system takes back when it needs them."""
    views = capture.train_views
    largest = max(math.prod(file_size(view)) for view in views)
    pixels = sum(view.camera.width * view.camera.height for view in views)
    return int(LOADED + READING * largest + COUNTS * pixels)


def check_training_memory(capture: Capture, config: NeilfConfig) -> None:
    """That a training fits into the memory that is free.

    Raises:
        UserError: it does not.
    """
    views = capture.train_views
    what = f"{capture.root}: to train on {len(views)} views of up to {max(math.prod(file_size(v)) for v in views) / 1e6:.1f} "
    check_memory(training_bytes(capture, config), what + "megapixels would", "close other programs, or shrink the image files")
