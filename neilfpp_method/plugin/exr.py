"""One clear line where nerfstudio's own code opens an EXR image, which it cannot read.

Its other methods open the images of `neilfpp-data` with Pillow, and so do its own dataparsers to learn their
size. Pillow would say only that it cannot identify the file.
"""

from __future__ import annotations

from os import fsdecode
from typing import Any, NoReturn

from PIL import Image

from neilfpp_method.errors import UserError

__all__ = ["explain_exr_to_pillow"]

MAGIC = b"\x76\x2f\x31\x01"
"""The first bytes of every EXR file."""


def explain_exr_to_pillow() -> None:
    """Have `PIL.Image.open` raise a `UserError` for EXR files. This package itself reads them otherwise."""
    Image.register_open("EXR", _refuse, lambda start: start.startswith(MAGIC))


def _refuse(file: Any, filename: Any) -> NoReturn:
    """The opener of Pillow for EXR files.

    Raises:
        UserError: always.
    """
    del file
    raise UserError(
        f"{fsdecode(filename) or 'a stream'}: this part of nerfstudio cannot read EXR images",
        "use a method neilfpp with the dataparser neilfpp-data, or 8-bit images",
    )
