"""Develop camera RAW files into linear radiance by LibRaw; needs the extra `raw`.

No parameter depends on the individual image: brightness and white level are fixed, and all images of a camera
model have the same white balance. Two images of a scene then differ only by their exposures.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from types import ModuleType

import cv2
import numpy as np
from jaxtyping import Bool, Float32, UInt16

from neilfpp_method.errors import UserError

__all__ = ["RAW_SUFFIXES", "Developed", "check_not_raw", "develop"]

RAW_SUFFIXES = (".dng", ".nef", ".cr2", ".cr3", ".arw", ".raf", ".orf", ".rw2", ".pef", ".srw")
INTERPOLATION_REACH = 5
"""Side of the square of sensor pixels around each pixel that demosaicing reads, in pixels."""


@dataclass(frozen=True)
class Developed:
    """A developed RAW file, in the orientation of the sensor.

    Attributes:
        pixels: linear radiance with the primaries of sRGB; 1 is the saturation level of the sensor.
        valid: false at saturated pixels.
        white_balance: the camera's own factors of red, green and blue, relative to green. They are not
            applied; the daylight balance of the camera model is used.
    """

    pixels: Float32[np.ndarray, "H W 3"]
    valid: Bool[np.ndarray, "H W"]
    white_balance: tuple[float, float, float]


def develop(path: Path) -> Developed:
    """Develop a RAW file.

    Raises:
        UserError: rawpy is not installed, or it cannot read the file.
    """
    rawpy = _rawpy(path)
    try:
        with rawpy.imread(str(path)) as raw:
            samples: UInt16[np.ndarray, "H W 3"] = raw.postprocess(
                output_bps=16,
                gamma=(1, 1),
                no_auto_bright=True,
                adjust_maximum_thr=0.0,
                user_wb=list(raw.daylight_whitebalance),
                output_color=rawpy.ColorSpace.sRGB,
                highlight_mode=rawpy.HighlightMode.Clip,
                user_flip=0,
            )
            saturated = _saturated(path, raw, samples.shape[:2])
            red, green, blue = (float(factor) for factor in raw.camera_whitebalance[:3])
    except UserError:
        raise
    except Exception as error:
        # The exceptions of LibRaw and of rawpy have no common base class.
        raise UserError(
            f"{path}: cannot be developed ({error})", "convert it to DNG, or to linear EXR"
        ) from error
    pixels = samples.astype(np.float32) / np.float32(65_535)
    balance = (red / green, 1.0, blue / green) if min(red, green, blue) > 0 else (1.0, 1.0, 1.0)
    return Developed(pixels, ~saturated, balance)


def check_not_raw(paths: Sequence[Path]) -> None:
    """Check that there is no camera RAW among images whose pixels are said to be sRGB values.

    Raises:
        UserError: there is one; `develop` makes linear radiance of it.
    """
    raw = next((path for path in paths if path.suffix.lower() in RAW_SUFFIXES), None)
    if raw is not None:
        raise UserError(
            f"{raw}: camera RAW is developed to linear radiance, not to sRGB values",
            "leave out the response srgb",
        )


def _rawpy(path: Path) -> ModuleType:
    try:
        import rawpy
    except ImportError as error:
        raise UserError(f"{path}: camera RAW needs rawpy", "pip install 'neilfpp-method[raw]'") from error
    return rawpy


def _saturated(path: Path, raw, size: tuple[int, int]) -> Bool[np.ndarray, "H W"]:
    """Pixels whose colour comes, wholly or in part, from a sensor pixel at its white level.

    Args:
        path: the file, for the message.
        raw: the file as rawpy opened it.
        size: height and width of the developed image, in pixels.
    """
    mosaic = raw.raw_image_visible
    if mosaic.shape[:2] != size:
        sensor, image = ("×".join(map(str, shape[::-1])) for shape in (mosaic.shape[:2], size))
        raise UserError(
            f"{path}: {image} pixels from a sensor of {sensor}, so its saturated pixels are unknown",
            "develop it with another program, to linear EXR",
        )
    full = (mosaic >= raw.white_level).reshape(*size, -1).any(axis=-1).astype(np.uint8)
    return cv2.dilate(full, np.ones((INTERPOLATION_REACH, INTERPOLATION_REACH), np.uint8)) > 0
