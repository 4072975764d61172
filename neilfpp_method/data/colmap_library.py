"""pycolmap, for every module that needs it: `from neilfpp_method.data.colmap_library import pycolmap`.

Loaded before OpenCV, it brings its own zlib into the process first, and OpenCV's PNG writer then aborts with
"free(): invalid pointer". OpenCV is therefore loaded before it, here and nowhere else.

It also has SIGTERM print a stack trace, as if the program had failed. What SIGTERM did before comes back,
and a SIGTERM that arrives while it is loaded waits until then.

Its interface changes with its versions, so others than those that this project is made for are refused when
they are loaded, and not somewhere in the middle of the work.
"""

from __future__ import annotations

from neilfpp_method.data.native_signals import sigterm_waits
from neilfpp_method.errors import UserError

with sigterm_waits():
    import cv2  # noqa: F401
    import pycolmap

__all__ = ["pycolmap"]

MIN_VERSION, END_VERSION = (4, 2), (5, 0)
"""Versions of pycolmap that are supported: from the first, before the second."""

if not MIN_VERSION <= tuple(int(part) for part in pycolmap.__version__.split(".")[:2]) < END_VERSION:
    raise UserError(
        f"pycolmap {pycolmap.__version__} is installed, of another interface",
        "pip install 'pycolmap>=4.2,<5'",
    )
