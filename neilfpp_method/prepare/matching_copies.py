"""8-bit copies of the photographs for feature extraction, because COLMAP reads neither EXR nor RAW files.

All linear images are tone-mapped at one exposure, after division by the camera's exposure of each image, so
that a point of the scene looks the same in all copies. Display values are copied unchanged.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from pathlib import Path

import numpy as np
import torch
from jaxtyping import Float32, UInt8

from neilfpp_method.data.files.images import write_png
from neilfpp_method.errors import UserError
from neilfpp_method.prepare.photos import Photo, Photos, read_photo
from neilfpp_method.shading.color import tone_map

__all__ = ["relative_exposures", "write_copies"]

GAIN_PHOTOS = 12
"""Number of photographs from which the common gain is computed; decoding all of them would take too long."""

BRIGHT_PERCENTILE = 90.0
"""Percentile of the lit pixels that is the bright level of an image; highlights are above it."""

BRIGHT_VALUE = 0.7
"""Linear value to which the common gain brings the bright level: a light grey with room for highlights."""


def write_copies(photos: Photos, folder: Path, advance: Callable[[], None]) -> tuple[str, ...]:
    """Write the copy `folder/NAME.png` of each photograph.

    Args:
        photos: the photographs.
        folder: folder of the copies; existing copies are kept.
        advance: called once per photograph.

    Returns:
        For each photograph that cannot be read, what is wrong with it.
    """
    exposures = relative_exposures(photos)
    gain = None
    problems: list[str] = []
    for photo in photos.items:
        copy = folder / f"{photo.name}.png"
        if not copy.is_file():
            try:
                pixels = read_photo(photo.path).pixels
                if photos.linear:
                    gain = gain or _common_gain(photos, exposures)
                    write_png(copy, _tone_mapped(pixels * np.float32(gain / exposures[photo.name])))
                else:
                    write_png(copy, _to_bytes(pixels))
            except UserError as error:
                problems.append(error.problem)
        advance()
    return tuple(problems)


def relative_exposures(photos: Photos) -> dict[str, float]:
    """Return each photograph's exposure relative to the median, by name; all 1 if EXIF lacks any of them."""
    known = [photo.exposure for photo in photos.items if photo.exposure is not None]
    if not photos.linear or len(known) < len(photos.items):
        return {photo.name: 1.0 for photo in photos.items}
    median = float(np.median(known))
    return {photo.name: (photo.exposure or median) / median for photo in photos.items}


def _common_gain(photos: Photos, exposures: Mapping[str, float]) -> float:
    """The factor that brings the median bright level of a sample of photographs to `BRIGHT_VALUE`."""
    step = -(-len(photos.items) // GAIN_PHOTOS)
    levels = [
        level / exposures[photo.name]
        for photo in photos.items[::step]
        if (level := _bright_level(photo)) is not None
    ]
    return BRIGHT_VALUE / float(np.median(levels)) if levels else 1.0


def _bright_level(photo: Photo) -> float | None:
    try:
        values = read_photo(photo.path).pixels[::4, ::4].mean(axis=2)
    except UserError:
        # `write_copies` reports this image.
        return None
    positive = values[values > 0]
    return float(np.percentile(positive, BRIGHT_PERCENTILE)) if len(positive) else None


def _tone_mapped(radiance: Float32[np.ndarray, "H W 3"]) -> UInt8[np.ndarray, "H W 3"]:
    return _to_bytes(tone_map(torch.from_numpy(radiance)).numpy())


def _to_bytes(values: Float32[np.ndarray, "H W 3"]) -> UInt8[np.ndarray, "H W 3"]:
    return np.rint(np.clip(values, 0.0, 1.0) * 255.0).astype(np.uint8)
