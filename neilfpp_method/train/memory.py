"""Check before a training that its memory is available."""

from __future__ import annotations

import math
from collections.abc import Sequence

from neilfpp_method.data.capture import Capture
from neilfpp_method.data.memory import check_memory
from neilfpp_method.data.scaling import file_size
from neilfpp_method.data.views import View

__all__ = ["check_training_memory", "training_bytes"]

BYTES_PER_READ_PIXEL = 48
"""Bytes per pixel of the largest image file while it is decoded, linearised, averaged and encoded (estimate).
"""
INDEX_BYTES_PER_PIXEL = 3 * 8 / 1024
"""Bytes per pixel of all views for the index of three sets of pixels: 8 bytes per block of 1024."""
BASE_BYTES = 0.8e9
"""Bytes of the libraries, the statistics of the images, and a model of preset `fast`."""


def training_bytes(views: Sequence[View]) -> int:
    """Lower bound of the memory of a training, in bytes.

    Mapped file pages are not counted because the system can reclaim them. The memory of a training step is
    not counted because it depends on the settings rather than on the images.
    """
    largest = max(math.prod(file_size(view)) for view in views)
    pixels = sum(view.camera.width * view.camera.height for view in views)
    return int(BASE_BYTES + BYTES_PER_READ_PIXEL * largest + INDEX_BYTES_PER_PIXEL * pixels)


def check_training_memory(capture: Capture) -> None:
    """Check that a training fits into the free memory.

    Raises:
        UserError: if it does not.
    """
    views = capture.train_views
    largest = max(math.prod(file_size(view)) for view in views) / 1e6
    what = f"{capture.root}: to train on {len(views)} views of up to {largest:.1f} megapixels would"
    check_memory(training_bytes(views), what, "close other programs, or make the image files smaller")
