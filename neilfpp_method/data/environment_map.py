"""Read environment maps of known radiance, in latitude and longitude (docs/light.md)."""

from __future__ import annotations

from pathlib import Path

import torch
from jaxtyping import Float
from torch import Tensor

from neilfpp_method.data.images import image_header, read_image
from neilfpp_method.errors import UserError

__all__ = ["check_environment", "read_environment"]

MIN_ROWS, MIN_COLUMNS = 4, 8
"""Smallest size of a map, in texels."""
MAX_ROWS, MAX_COLUMNS = 2048, 4096
"""Largest size of a map, in texels; bounds the memory."""


def check_environment(path: Path) -> None:
    """Check that the header of a file is that of an environment map, without reading its pixels.

    Raises:
        UserError: the file does not exist, is no EXR file, or is smaller than 4×8 or larger than 2048×4096
            texels.
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

    Raises:
        UserError: as `check_environment`, or the pixels cannot be read, are NaN, infinite or negative, or all
            black.
    """
    check_environment(path)
    radiance = torch.from_numpy(read_image(path).pixels).permute(2, 0, 1)
    if not radiance.isfinite().all() or radiance.amin() < 0:
        raise UserError(f"{path}: a texel is NaN, infinite or negative", "store radiance as it is, from 0 on")
    if not radiance.any():
        raise UserError(
            f"{path}: the environment map is black", "give the light that was there, or leave --light out"
        )
    return radiance.expand(3, -1, -1)
