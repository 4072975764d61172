"""What a training takes of memory, asked before it takes any."""

from __future__ import annotations

import math
from collections.abc import Sequence

from neilfpp_method.data.capture import Capture
from neilfpp_method.data.memory import check_memory
from neilfpp_method.data.scaling import file_size
from neilfpp_method.data.views import View

__all__ = ["check_training_memory", "training_bytes"]

READING = 48
"""Bytes per pixel of the largest file while decoded, made linear, averaged and encoded. Estimate."""
COUNTED = 3 * 8 / 1024
"""Bytes to a pixel of all views: counts of three sets of pixels, by block."""
LOADED = 0.8e9
"""Bytes of a training with its libraries, the statistics of the images, and a model of the preset `fast`."""


def training_bytes(views: Sequence[View]) -> int:
    """About the least memory of a training, in bytes, without file pages, which the system reclaims.

    What single steps take is left out: it follows from the settings, not from the images.
    """
    largest = max(math.prod(file_size(view)) for view in views)
    pixels = sum(view.camera.width * view.camera.height for view in views)
    return int(LOADED + READING * largest + COUNTED * pixels)


def check_training_memory(capture: Capture) -> None:
    """That a training fits into the memory that is free.

    Raises:
        UserError: it does not.
    """
    views = capture.train_views
    largest = max(math.prod(file_size(view)) for view in views) / 1e6
    what = f"{capture.root}: to train on {len(views)} views of up to {largest:.1f} megapixels would"
    check_memory(training_bytes(views), what, "close other programs, or make the image files smaller")
