"""pycolmap, for every module that needs it: `from neilfpp_method.data.colmap_library import pycolmap`.

Loaded before OpenCV, it brings its own zlib into the process first, and OpenCV's PNG writer then aborts with "free():
invalid pointer". OpenCV is therefore loaded before it, here and nowhere else.
"""

from __future__ import annotations

import cv2  # noqa: F401
import pycolmap

__all__ = ["pycolmap"]
