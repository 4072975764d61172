"""Pictures inside a page: encoded small, as data addresses."""

from __future__ import annotations

import base64
import io

import numpy as np
from jaxtyping import Bool, UInt8
from PIL import Image

__all__ = ["data_address", "encoded"]

QUALITY = 88
"""Of WebP, out of 100: no step is seen in a smooth map at this quality."""


def encoded(picture: UInt8[np.ndarray, "H W 3"], shown: Bool[np.ndarray, "H W"] | None = None) -> str:
    """A picture as a data address, transparent where `shown` is False, for light and dark pages."""
    if shown is not None and not shown.all():
        alpha = np.where(shown, 255, 0).astype(np.uint8)[..., None]
        picture = np.concatenate([picture, alpha], axis=-1)
    file = io.BytesIO()
    Image.fromarray(np.ascontiguousarray(picture)).save(file, "WEBP", quality=QUALITY, method=4)
    return data_address(file.getvalue(), "image/webp")


def data_address(data: bytes, kind: str) -> str:
    """Bytes as a `data:` address of a media type."""
    return f"data:{kind};base64,{base64.b64encode(data).decode('ascii')}"
