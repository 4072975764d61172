"""Read EXR, TIFF, PNG, JPEG and Radiance HDR files into float arrays, and write EXR and PNG files.

Files are not trusted: a header is read and its size checked before any pixel is allocated, and a file that
cannot be decoded raises a `UserError` that names it. Pixels keep the orientation in which they are stored.
EXIF orientation is not applied, because cameras are calibrated for the stored pixels.
"""

from __future__ import annotations

import os
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
import OpenEXR
from jaxtyping import Float, Shaped
from PIL import Image

from neilfpp_method.data.files.atomic_file import replacing
from neilfpp_method.data.files.exr import exr_header, exr_samples
from neilfpp_method.data.files.exr_chunks import has_all_chunks
from neilfpp_method.data.files.image_parts import ImageHeader, rgb_of_opencv
from neilfpp_method.data.files.png import check_png_chunks
from neilfpp_method.data.files.radiance_hdr import hdr_header, hdr_samples
from neilfpp_method.data.files.tiff import tiff_header, tiff_samples
from neilfpp_method.errors import UserError

__all__ = [
    "IMAGE_SUFFIXES",
    "UNREAD_SUFFIXES",
    "ImageFile",
    "image_header",
    "read_image",
    "write_exr",
    "write_png",
]

MAX_SIDE = 65_536
"""Longest side of an image, in pixels."""
MAX_PIXELS = 2**30
"""Largest number of pixels of an image; bounds the memory."""
MAX_LABEL = 1.001 / 255
"""Largest value of a mask file, in [0, 1], at which it contains labels instead of brightness: 1 of 255."""
SIGNATURES = {b"\x89PNG": ".png", b"\xff\xd8\xff": ".jpg"}
"""First bytes of PNG and JPEG files, which are recognised by them, because renamed files are common."""
PILLOW_FORMATS = ("PNG", "JPEG")
"""Formats that Pillow may recognise. It would start Ghostscript for a PostScript file with another suffix."""


@dataclass(frozen=True)
class ImageFile:
    """A decoded image, rows from top to bottom, contiguous.

    Attributes:
        pixels: RGB or one channel; as stored if `hdr`, otherwise display values scaled to [0, 1].
        alpha: alpha channel in [0, 1]; None if the file has none, or one that is opaque everywhere, which
            many programs write although the object does not fill the image.
        hdr: whether the samples are floating point.
    """

    pixels: Float[np.ndarray, "H W C"]
    alpha: Float[np.ndarray, "H W"] | None
    hdr: bool

    @property
    def mask(self) -> Float[np.ndarray, "H W"]:
        """The values of a mask file, in [0, 1]: its alpha channel if it has one, else its brightest channel.

        Tools that cut out objects write the mask as the alpha channel of a white image or of the photograph.
        Segmentation tools write the labels 0 and 1; a file whose largest value is 1 of 255 is read as such.
        """
        values = self.pixels.max(axis=-1) if self.alpha is None else self.alpha
        return (values > 0).astype(np.float32) if 0 < values.max() <= MAX_LABEL else values


# --------------------------------------------------------------------------------------------- kinds of files


def _exr_header(path: Path) -> ImageHeader:
    header = exr_header(path)
    # All parts are checked, because OpenEXR decodes all of them.
    for stored in header.stored:
        _check_size(path, stored.width, stored.height)
    return ImageHeader(header.frame.width, header.frame.height, hdr=True)


def _pillow_header(path: Path) -> ImageHeader:
    with Image.open(path, formats=PILLOW_FORMATS) as image:
        return ImageHeader(*image.size, hdr=False)


def _opencv_samples(path: Path) -> Shaped[np.ndarray, "H W C"]:
    # IMREAD_UNCHANGED also ignores the EXIF orientation.
    return rgb_of_opencv(cv2.imread(str(path), cv2.IMREAD_UNCHANGED))


def _png_samples(path: Path) -> Shaped[np.ndarray, "H W C"]:
    check_png_chunks(path)
    with Image.open(path, formats=PILLOW_FORMATS) as image:
        if "transparency" in image.info and image.mode in ("P", "L", "1"):
            # OpenCV ignores the transparent colours of palettes and of grey images.
            return np.asarray(image.convert("RGBA"))
    return _opencv_samples(path)


def _jpeg_samples(path: Path) -> Shaped[np.ndarray, "H W C"]:
    # Not OpenCV, which silently fills the missing part of a truncated file with grey.
    with Image.open(path, formats=PILLOW_FORMATS) as image:
        return np.atleast_3d(np.asarray(image if image.mode == "L" else image.convert("RGB")))


# ---------------------------------------------------------------------------------------------------- reading


@dataclass(frozen=True)
class Format:
    """Functions that read the header and the samples of a file format: (H, W, C), RGB, alpha last."""

    header: Callable[[Path], ImageHeader]
    samples: Callable[[Path], np.ndarray]


TIFF = Format(tiff_header, tiff_samples)
JPEG = Format(_pillow_header, _jpeg_samples)
FORMATS: Mapping[str, Format] = {
    ".exr": Format(_exr_header, exr_samples),
    ".hdr": Format(hdr_header, hdr_samples),
    ".tif": TIFF,
    ".tiff": TIFF,
    ".png": Format(_pillow_header, _png_samples),
    ".jpg": JPEG,
    ".jpeg": JPEG,
}
"""The formats by the suffix of a file, in small letters."""
IMAGE_SUFFIXES = tuple(FORMATS)
UNREAD_SUFFIXES = (".heic", ".heif", ".avif", ".jxl", ".jp2", ".webp", ".bmp")
"""Suffixes of photographs in formats that are not read."""
FULL_SCALE = {"uint8": 255.0, "uint16": 65_535.0, "float16": 1.0, "float32": 1.0, "float64": 1.0}
"""Sample that becomes 1, by the type of the samples."""


def image_header(path: Path) -> ImageHeader:
    """Read the size and the sample type of an image, without its pixels.

    Raises:
        UserError: the file does not exist, cannot be read, or has more than 65536 pixels a side or 2³⁰
            pixels.
    """
    with _naming(path):
        header = _format(path).header(path)
        _check_size(path, header.width, header.height)
        return header


def read_image(path: Path) -> ImageFile:
    """Decode an image.

    Raises:
        UserError: as `image_header`, or the pixels are damaged, or of a type that is not 8 or 16 bit, half or
            float.
    """
    header = image_header(path)
    with _naming(path):
        samples = _format(path).samples(path)
        height, width, channels = samples.shape
        if (width, height) != (header.width, header.height):
            raise ValueError(f"{width}×{height} pixels where the header says {header.width}×{header.height}")
        if samples.dtype.name not in FULL_SCALE:
            raise ValueError(f"samples of type {samples.dtype.name}")
    values = np.divide(
        samples, np.float32(FULL_SCALE[samples.dtype.name]), dtype=np.float32, casting="same_kind"
    )
    colors = channels if channels in (1, 3) else channels - 1
    alpha = np.ascontiguousarray(values[..., colors]) if channels > colors else None
    opaque = alpha is None or bool((alpha == 1).all())
    return ImageFile(np.ascontiguousarray(values[..., :colors]), None if opaque else alpha, header.hdr)


@contextmanager
def _naming(path: Path) -> Iterator[None]:
    """Turn the exceptions of decoders into a `UserError` that names the file."""
    try:
        with _decoders_silent():
            yield
    except UserError:
        raise
    except FileNotFoundError:
        raise UserError(f"{path}: no such image", "check the path") from None
    except Exception as error:
        # Each of the four decoders has its own exception types.
        reason = str(error).strip().splitlines() or [type(error).__name__]
        raise UserError(
            f"{path}: cannot be read ({reason[0]})", "export the image again, as EXR or PNG"
        ) from error


@contextmanager
def _decoders_silent() -> Iterator[None]:
    """Discard what native decoders print to standard error; the `UserError` reports it in one line."""
    saved_stderr = os.dup(2)
    with open(os.devnull, "wb") as nowhere:
        os.dup2(nowhere.fileno(), 2)
    try:
        yield
    finally:
        os.dup2(saved_stderr, 2)
        os.close(saved_stderr)


def _format(path: Path) -> Format:
    suffix = path.suffix.lower()
    if path.is_dir():
        raise UserError(f"{path}: a folder where an image is wanted", "name a file in it")
    if suffix not in FORMATS:
        raise UserError(f"{path}: not an image format that is read", f"use one of {', '.join(FORMATS)}")
    if not path.is_file():
        raise FileNotFoundError
    if FORMATS[suffix].header is _pillow_header:
        with path.open("rb") as file:
            start = file.read(4)
        suffix = next((kind for begin, kind in SIGNATURES.items() if start.startswith(begin)), suffix)
    return FORMATS[suffix]


def _check_size(path: Path, width: int, height: int) -> None:
    if not (0 < width <= MAX_SIDE and 0 < height <= MAX_SIDE and width * height <= MAX_PIXELS):
        raise UserError(
            f"{path}: the header says {width}×{height} pixels",
            f"images of up to {MAX_SIDE} a side and {MAX_PIXELS} pixels are read",
        )


# ---------------------------------------------------------------------------------------------------- writing


def write_exr(path: Path, channels: Mapping[str, Shaped[np.ndarray, "H W ..."]]) -> None:
    """Write channels, losslessly compressed: "RGB" or "RGBA" for (H, W, 3 | 4), any other name for (H, W).

    float16 is stored as half, everything else as float.
    """
    kinds = {
        name: np.float16 if array.dtype == np.float16 else np.float32 for name, array in channels.items()
    }
    arrays = {name: np.ascontiguousarray(array, kinds[name]) for name, array in channels.items()}
    header = {"compression": OpenEXR.ZIP_COMPRESSION, "type": OpenEXR.scanlineimage}
    with replacing(path) as temporary:
        try:
            OpenEXR.File(header, arrays).write(str(temporary))
        except RuntimeError as error:
            # OpenEXR reports a full disk as a RuntimeError.
            raise OSError(" ".join(str(error).split()).rstrip(".")) from error
        # It does not report that the last rows are missing.
        if not has_all_chunks(temporary):
            raise OSError("pixels are missing")


def write_png(path: Path, samples: Shaped[np.ndarray, "H W ..."]) -> None:
    """Write 8- or 16-bit samples without conversion: (H, W), (H, W, 1), RGB or RGBA.

    Raises:
        ValueError: the samples are of another type.
    """
    if samples.dtype.name not in ("uint8", "uint16"):
        raise ValueError(f"PNG holds uint8 or uint16, not {samples.dtype.name}")
    if samples.ndim == 3 and samples.shape[2] > 1:
        samples = samples[..., [2, 1, 0, 3][: samples.shape[2]]]
    encoded = cv2.imencode(".png", np.ascontiguousarray(samples))[1]
    with replacing(path) as temporary:
        temporary.write_bytes(encoded.tobytes())
