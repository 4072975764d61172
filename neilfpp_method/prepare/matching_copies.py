"""8-bit copies of the photographs, for finding features: COLMAP reads no EXR and no RAW.

All linear images are shown at one exposure, so that a point looks alike wherever it is seen; differences in
the camera's own exposure are divided out. Display values are copied as they are.
"""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import numpy as np
import torch
from jaxtyping import Float32, UInt8

from neilfpp_method.data.images import write_png
from neilfpp_method.errors import UserError
from neilfpp_method.prepare.photos import Photo, Photos, read_photo
from neilfpp_method.shading.color import tone_map

__all__ = ["relative_exposures", "write_copies"]

LOOKED_AT = 12
BRIGHT, SHOWN_AT = 90.0, 0.7


def write_copies(photos: Photos, folder: Path, advance: Callable[[], None]) -> tuple[str, ...]:
    """Write `folder/NAME.png` for photographs without one; returns what is wrong with unreadable ones.

    Args:
        photos: the photographs.
        folder: where the copies go; copies that are there are kept.
        advance: called once per photograph.
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
                    gain = gain or _common_gain(photos)
                    write_png(copy, _shown(pixels * np.float32(gain / exposures[photo.name])))
                else:
                    write_png(copy, _to_bytes(pixels))
            except UserError as error:
                problems.append(error.problem)
        advance()
    return tuple(problems)


def relative_exposures(photos: Photos) -> dict[str, float]:
    """Each photograph's exposure over their median, by name; all 1 unless EXIF has it for every one."""
    known = [photo.exposure for photo in photos.items if photo.exposure is not None]
    if not photos.linear or len(known) < len(photos.items):
        return {photo.name: 1.0 for photo in photos.items}
    middle = float(np.median(known))
    return {photo.name: (photo.exposure or middle) / middle for photo in photos.items}


def _common_gain(photos: Photos) -> float:
    """The factor that brings the bright end of what a dozen photographs show to a light grey."""
    exposures = relative_exposures(photos)
    step = -(-len(photos.items) // LOOKED_AT)
    levels = {
        photo.name: level for photo in photos.items[::step] if (level := _bright_level(photo)) is not None
    }
    return (
        SHOWN_AT / float(np.median([level / exposures[name] for name, level in levels.items()]))
        if levels
        else 1.0
    )


def _bright_level(photo: Photo) -> float | None:
    try:
        values = read_photo(photo.path).pixels[::4, ::4].mean(axis=2)
    except UserError:  # told when its own turn comes
        return None
    lit = values[values > 0]
    return float(np.percentile(lit, BRIGHT)) if len(lit) else None


def _shown(radiance: Float32[np.ndarray, "H W 3"]) -> UInt8[np.ndarray, "H W 3"]:
    return _to_bytes(tone_map(torch.from_numpy(radiance)).numpy())


def _to_bytes(values: Float32[np.ndarray, "H W 3"]) -> UInt8[np.ndarray, "H W 3"]:
    return np.rint(np.clip(values, 0.0, 1.0) * 255.0).astype(np.uint8)
