"""Radiance HDR files (`.hdr`).

Stored values are multiplied by every EXPOSURE of the header, and their channels by every COLORCORR, and rows
may be stored in any order. OpenCV decodes the pixels, but undoes none of this.
"""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
from jaxtyping import Shaped

from neilfpp_method.data.files.image_parts import ImageHeader, rgb_of_opencv

__all__ = ["hdr_header", "hdr_samples"]

MAX_HEADER = 65_536
"""Largest size of a header, in bytes. Tools append their command lines to it."""


def hdr_header(path: Path) -> ImageHeader:
    """Read the size in the header of a file.

    Raises:
        ValueError: the header is damaged, or the colours are not RGB.
    """
    lines = _lines(path)
    if b"FORMAT=32-bit_rle_xyze" in lines:
        raise ValueError("its colours are XYZ, not RGB")
    sizes = {axis[1:]: size for axis, size in _axes(lines[-1]).items()}
    return ImageHeader(sizes[b"X"], sizes[b"Y"], hdr=True)


def hdr_samples(path: Path) -> Shaped[np.ndarray, "H W C"]:
    """Decode linear radiance, rows from top to bottom, divided by the factors of the header.

    Raises:
        ValueError: the file is damaged, or a factor is not positive.
    """
    lines = _lines(path)
    factors = np.ones(3)
    for line in lines:
        if line.startswith((b"EXPOSURE=", b"COLORCORR=")):
            factors *= [float(word) for word in line.split(b"=")[1].split()]
    if not (np.isfinite(factors).all() and (factors > 0).all()):
        raise ValueError(f"an exposure or a colour correction of {factors.min():g}")
    axes = _axes(lines[-1])
    pixels = path.read_bytes()[len(b"\n".join(lines)) :]
    upright = b"\n".join([*lines[:-1], b"-Y %d +X %d" % tuple(axes.values())]) + pixels
    samples = rgb_of_opencv(cv2.imdecode(np.frombuffer(upright, np.uint8), cv2.IMREAD_UNCHANGED))
    samples = samples if next(iter(axes)).endswith(b"Y") else samples.swapaxes(0, 1)
    return samples[:: -1 if b"+Y" in axes else 1, :: -1 if b"-X" in axes else 1] / factors.astype(np.float32)


def _lines(path: Path) -> list[bytes]:
    """The lines of the header, an empty line, and the line with the size."""
    with path.open("rb") as file:
        lines = file.read(MAX_HEADER).split(b"\n")
    if b"" not in lines:
        raise ValueError(f"its header does not end within {MAX_HEADER} bytes with an empty line")
    return lines[: lines.index(b"") + 2]


def _axes(line: bytes) -> dict[bytes, int]:
    """The axes of a file and their lengths, the slow one first: {b"-Y": 480, b"+X": 640} for `-Y 480 +X 640`.

    Raises:
        ValueError: the line is not a size.
    """
    slow, rows, fast, columns = line.split()
    if {slow[:1], fast[:1]} - {b"+", b"-"} or {slow[1:], fast[1:]} != {b"X", b"Y"}:
        raise ValueError("its size is not of the form -Y 480 +X 640")
    return {slow: int(rows), fast: int(columns)}
