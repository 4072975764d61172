"""Read environment maps of known radiance, in latitude and longitude (docs/light.md)."""

from __future__ import annotations

from pathlib import Path

import torch
from jaxtyping import Float
from torch import Tensor

from neilfpp_method.data.files.images import image_header, read_image
from neilfpp_method.errors import UserError

__all__ = ["check_environment", "check_radiance", "read_environment"]

MIN_ROWS, MIN_COLUMNS = 4, 8
"""Smallest size of a map, in texels."""
MAX_ROWS, MAX_COLUMNS = 2048, 4096
"""Largest size of a map, in texels; bounds the memory."""
RINGING = 0.01
"""Largest magnitude of negative texels that count as 0, relative to the mean. Filters that sharpen produce
them: three of four photographed skies have some.
"""


def check_environment(path: Path) -> None:
    """Check that the header of a file is that of an environment map, without reading its pixels.

    Raises:
        UserError: the file does not exist, is not an EXR file, or is smaller than 4×8 or larger than
            2048×4096 texels.
    """
    if path.suffix.lower() != ".exr":
        raise UserError(f"{path}: an environment map is linear radiance in an EXR file", "convert it to EXR")
    header = image_header(path)
    small = header.height < MIN_ROWS or header.width < MIN_COLUMNS
    if small or header.height > MAX_ROWS or header.width > MAX_COLUMNS:
        raise UserError(
            f"{path}: an environment map of {header.height} rows and {header.width} columns",
            f"scale it to between {MIN_ROWS}×{MIN_COLUMNS} and {MAX_ROWS}×{MAX_COLUMNS}",
        )


def read_environment(path: Path) -> Float[Tensor, "3 H W"]:
    """Read the linear radiance of a lat-long map, with rows from +z downwards; a single channel is repeated.

    Slightly negative texels are set to 0.

    Raises:
        UserError: as `check_environment` and `check_radiance`, or the pixels cannot be read, or the map is
            black.
    """
    check_environment(path)
    radiance = torch.from_numpy(read_image(path).pixels).permute(2, 0, 1)
    check_radiance(radiance, path)
    radiance = radiance.clamp_min(0)
    if not radiance.any():
        raise UserError(
            f"{path}: the environment map is black", "give the light that was there, or leave --light out"
        )
    return radiance.expand(3, -1, -1)


def check_radiance(radiance: Float[Tensor, ...], path: Path) -> None:
    """Check that the texels of a map can be radiance; negative ones as small as `RINGING` are accepted.

    Raises:
        UserError: a texel is NaN, infinite or negative.
    """
    if not radiance.isfinite().all():
        raise UserError(f"{path}: a texel is NaN or infinite", "store linear radiance, 0 or larger")
    if radiance.amin() < -RINGING * radiance.mean().clamp_min(0):
        raise UserError(
            f"{path}: a texel is negative ({radiance.amin():.3g})", "store linear radiance, 0 or larger"
        )
