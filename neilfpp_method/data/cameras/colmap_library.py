"""The import of pycolmap for all modules: `from neilfpp_method.data.cameras.colmap_library import pycolmap`.

If pycolmap is loaded before OpenCV, its own zlib is used by OpenCV's PNG writer, which then aborts with
"free(): invalid pointer". OpenCV is therefore imported first, here.

pycolmap installs a handler that prints a stack trace on SIGTERM. The previous handler is restored, and a
signal that arrives during the import is delivered afterwards.

The interface of pycolmap changes between versions, so unsupported versions are refused at the import and not
in the middle of a command.
"""

from __future__ import annotations

from neilfpp_method.data.native_signals import signals_delayed
from neilfpp_method.errors import UserError

with signals_delayed():
    import cv2  # noqa: F401
    import pycolmap

__all__ = ["pycolmap"]

MIN_VERSION, END_VERSION = (4, 2), (5, 0)
"""Supported versions of pycolmap: from the first, and before the second."""

if not MIN_VERSION <= tuple(int(part) for part in pycolmap.__version__.split(".")[:2]) < END_VERSION:
    raise UserError(
        f"pycolmap {pycolmap.__version__} is installed and has another interface",
        "pip install 'pycolmap>=4.2,<5'",
    )
