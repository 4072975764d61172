"""Images as compressed data URLs, which a page contains instead of loading files."""

from __future__ import annotations

import base64
import io

import numpy as np
from jaxtyping import Bool, UInt8
from PIL import Image

__all__ = ["data_url", "image_url"]

QUALITY = 88
"""Quality of WebP, out of 100. At this value smooth maps show no visible steps."""


def image_url(picture: UInt8[np.ndarray, "H W 3"], mask: Bool[np.ndarray, "H W"] | None = None) -> str:
    """Encode an image as a data URL; pixels outside of the mask are transparent, for light and dark pages."""
    if mask is not None and not mask.all():
        alpha = np.where(mask, 255, 0).astype(np.uint8)[..., None]
        picture = np.concatenate([picture, alpha], axis=-1)
    file = io.BytesIO()
    Image.fromarray(np.ascontiguousarray(picture)).save(file, "WEBP", quality=QUALITY, method=4)
    return data_url(file.getvalue(), "image/webp")


def data_url(data: bytes, kind: str) -> str:
    """Encode bytes of a media type as a `data:` URL."""
    return f"data:{kind};base64,{base64.b64encode(data).decode('ascii')}"
