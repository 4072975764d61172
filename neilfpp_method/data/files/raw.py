"""Develop camera RAW files into linear radiance by LibRaw; needs the extra `raw`.

No parameter depends on the individual image: brightness and white level are fixed, and all images of a camera
model have the same white balance. Two images of a scene then differ only by their exposures.
"""

from __future__ import annotations

import subprocess
import sys
from collections.abc import Sequence
from dataclasses import dataclass
from importlib.util import find_spec
from pathlib import Path
from tempfile import TemporaryDirectory

import cv2
import numpy as np
from jaxtyping import Bool, Float32, Shaped

from neilfpp_method.errors import UserError

__all__ = ["RAW_SUFFIXES", "Developed", "check_not_raw", "develop"]

RAW_SUFFIXES = (".dng", ".nef", ".cr2", ".cr3", ".arw", ".raf", ".orf", ".rw2", ".pef", ".srw")
INTERPOLATION_REACH = 5
"""Side of the square of sensor pixels around each pixel that demosaicing reads, in pixels."""
DECODER = Path(__file__).with_name("raw_decoder.py")
SECONDS, MEMORY = 300.0, 8 << 30
"""Time and bytes of address space that decoding a file may take; 100 million pixels take about 3 GB."""


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
    """Develop a RAW file in a process of its own (`raw_decoder`), so that a damaged file harms nothing.

    Raises:
        UserError: rawpy is not installed, or it cannot read the file within `SECONDS` and `MEMORY`.
    """
    if find_spec("rawpy") is None:
        raise UserError(f"{path}: camera RAW needs rawpy", "pip install 'neilfpp-method[raw]'")
    with TemporaryDirectory() as folder:
        decoded = Path(folder) / "decoded.npz"
        _decode(path, decoded)
        with np.load(decoded) as arrays:
            samples, mosaic = arrays["samples"], arrays["mosaic"]
            white_level, camera_balance = arrays["white_level"], arrays["camera_balance"]
    saturated = _saturated(path, mosaic, int(white_level), samples.shape[:2])
    red, green, blue = camera_balance.tolist()
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


def _decode(path: Path, out: Path) -> None:
    """Run LibRaw on a file in a child process, which writes `out`.

    Raises:
        UserError: the process ends without a result: by an error, a crash, or one of the limits.
    """
    command = [sys.executable, str(DECODER), str(path), str(out), str(MEMORY)]
    quiet = subprocess.DEVNULL
    try:
        status = subprocess.run(command, stdin=quiet, stdout=quiet, stderr=quiet, timeout=SECONDS).returncode
        if status == 0:
            return
        message, how = out.with_suffix(".txt"), f"signal {-status}" if status < 0 else f"status {status}"
        reason = message.read_text("utf-8") if message.exists() else f"LibRaw ended by {how}"
    except subprocess.TimeoutExpired:
        reason = f"LibRaw did not finish within {SECONDS:.0f} s"
    raise UserError(f"{path}: cannot be developed ({reason})", "convert it to DNG, or to linear EXR")


def _saturated(
    path: Path, mosaic: Shaped[np.ndarray, "*sensor"], white_level: int, size: tuple[int, int]
) -> Bool[np.ndarray, "H W"]:
    """Pixels whose colour comes, wholly or in part, from a sensor pixel at its white level.

    Args:
        path: the file, for the message.
        mosaic: the visible pixels of the sensor.
        white_level: their value at saturation.
        size: height and width of the developed image, in pixels.
    """
    if mosaic.shape[:2] != size:
        sensor, image = ("×".join(map(str, shape[::-1])) for shape in (mosaic.shape[:2], size))
        raise UserError(
            f"{path}: {image} pixels from a sensor of {sensor}, so its saturated pixels are unknown",
            "develop it with another program, to linear EXR",
        )
    full = (mosaic >= white_level).reshape(*size, -1).any(axis=-1).astype(np.uint8)
    return cv2.dilate(full, np.ones((INTERPOLATION_REACH, INTERPOLATION_REACH), np.uint8)) > 0
