"""TIFF files: choose the page that is the image, and decode it with tifffile or with OpenCV."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
import tifffile
from jaxtyping import Shaped

from neilfpp_method.data.files.image_parts import ImageHeader, rgb_of_opencv

__all__ = ["tiff_header", "tiff_samples"]

COLORS = ("MINISBLACK", "MINISWHITE", "RGB", "PALETTE", "SEPARATED", "YCBCR")
"""Meanings of the colours of a TIFF file that are read."""
STORED_COLORS = ("MINISBLACK", "RGB")
"""Meanings of the colours with which stored values are brightness or RGB."""
DECODED_COMPRESSIONS = ("NONE", "ADOBE_DEFLATE", "DEFLATE", "PACKBITS")
"""Compressions that tifffile decodes without further packages; OpenCV decodes the others."""
PREDICTORS = (tifffile.PREDICTOR.NONE, tifffile.PREDICTOR.HORIZONTAL)
"""Predictors that tifffile undoes without further packages."""
FULL_BITS = (8, 16, 32, 64)
"""Sizes of samples that fill the type in which they are decoded."""
ALPHA_APART = tifffile.EXTRASAMPLE.UNASSALPHA
"""Kind of the alpha channel by which colours are not multiplied yet."""


def tiff_header(path: Path) -> ImageHeader:
    """Read the header of a file; it raises whatever tifffile raises for a damaged one."""
    with tifffile.TiffFile(path) as file:
        page = _page(file)
        return ImageHeader(page.imagewidth, page.imagelength, hdr=np.issubdtype(page.dtype, np.floating))


def tiff_samples(path: Path) -> Shaped[np.ndarray, "H W C"]:
    """Decode the samples of a file: RGB or one channel, alpha last.

    Raises:
        ValueError: the colours have another meaning, or cannot be decoded without loss.
    """
    with tifffile.TiffFile(path) as file:
        page = _page(file)
        if page.photometric.name not in COLORS:
            raise ValueError(f"its colours are {page.photometric.name}, not RGB")
        is_plain = page.compression.name in DECODED_COMPRESSIONS and page.predictor in PREDICTORS
        if is_plain and page.photometric.name in STORED_COLORS and page.bitspersample in FULL_BITS:
            # OpenCV multiplies 8-bit colours by an alpha that is not associated, refuses rotated images and
            # further channels, does not support half precision, and reads separate planes as pixels.
            samples = page.asarray()
            is_planar = page.planarconfig == tifffile.PLANARCONFIG.SEPARATE and page.samplesperpixel > 1
            samples = np.atleast_3d(np.moveaxis(samples, 0, -1) if is_planar else samples)
            return _colors_and_alpha(samples, 3 if page.photometric.name == "RGB" else 1, page.extrasamples)
        if ALPHA_APART in page.extrasamples and page.dtype == np.uint8:
            raise ValueError(f"{page.compression.name} compression with an alpha that is not associated")
        _, samples = cv2.imreadmulti(str(path), page.index, 1, flags=cv2.IMREAD_UNCHANGED)
    return rgb_of_opencv(samples[0] if samples else None)


def _page(file: tifffile.TiffFile) -> tifffile.TiffPage:
    """The first page that is not a reduced copy of another: a thumbnail may come before the image."""
    return next((page for page in file.pages if not page.is_reduced), file.pages[0])


def _colors_and_alpha(
    samples: Shaped[np.ndarray, "H W C"], colors: int, extra: tuple[int, ...]
) -> Shaped[np.ndarray, "H W c"]:
    """Colours and alpha of a TIFF. A single further channel of unspecified meaning is taken as the alpha."""
    alpha = [i for i, kind in enumerate(extra) if kind != tifffile.EXTRASAMPLE.UNSPECIFIED]
    alpha = alpha or [0] * (len(extra) == 1)
    return samples[..., [*range(colors), *(colors + i for i in alpha[:1])]]
