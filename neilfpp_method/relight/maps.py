"""Environment maps in: EXR, Radiance HDR, or a picture, in this package's or the common layout."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

import torch

from neilfpp_method.data.images import image_header, read_image
from neilfpp_method.data.views import plain_name
from neilfpp_method.errors import UserError
from neilfpp_method.relight.sky import Sky
from neilfpp_method.shading.color import srgb_to_linear

__all__ = ["Layout", "LightMap", "check_map", "map_names", "read_map"]

Layout = Literal["ours", "common"]

MIN_ROWS, MAX_ROWS = 4, 4096
RINGING = 0.01
"""Of a map's mean: filters that sharpen leave negative texels as small as this; they count as 0."""
QUARTER_TURN = math.pi / 2
"""The common layout's middle column is +x, with −y on its right; ours has +y at its left edge."""


@dataclass(frozen=True)
class LightMap:
    """A map that was read, and how many of its texels were slightly negative and count as 0."""

    sky: Sky
    negative: int


def check_map(path: Path) -> None:
    """That a file says of itself that it can be an environment map; its pixels are not read.

    Raises:
        UserError: no such file, no image, or not of the shape of a whole sphere.
    """
    header = image_header(path)
    if not MIN_ROWS <= header.height <= MAX_ROWS:
        raise UserError(
            f"{path}: an environment map of {header.height} rows",
            f"scale it to between {MIN_ROWS} and {MAX_ROWS} rows",
        )
    # Twice as many columns as rows; a map with rows at both poles may have one row more.
    if abs(header.width - 2 * header.height) > 2:
        raise UserError(
            f"{path}: {header.width} columns and {header.height} rows are no map in latitude and longitude",
            "give a map with twice as many columns as rows",
        )


def read_map(path: Path, layout: Layout, rotate: float = 0.0, exposure: float = 0.0) -> LightMap:
    """The light of a map about the capture's +z.

    Args:
        path: linear radiance where the file holds floats; other images are decoded from sRGB.
        layout: "ours" (docs/light.md), or "common": rows at pixel centres, as Blender and most programs have
            them.
        rotate: degrees by which the light is turned about +z, counter-clockwise seen from above.
        exposure: stops by which the light is made brighter.

    Raises:
        UserError: as `check_map`; or texels are NaN, infinite or negative, or the map is black.
    """
    check_map(path)
    file = read_image(path)
    radiance = torch.from_numpy(file.pixels)
    if not file.hdr:
        radiance = srgb_to_linear(radiance)
    if not radiance.isfinite().all():
        raise UserError(f"{path}: a texel is NaN or infinite", "store linear radiance, from 0 on")
    negative = radiance < 0
    if radiance.amin() < -RINGING * radiance.mean().clamp_min(0):
        raise UserError(
            f"{path}: a texel is negative ({radiance.amin():.3g})", "store linear radiance, from 0 on"
        )
    radiance = radiance.clamp_min(0).expand(-1, -1, 3) * 2.0**exposure
    if not (radiance.any() and radiance.isfinite().all()):
        raise UserError(
            f"{path}: the environment map is black, or beyond all numbers", "see to --exposure and to the map"
        )
    start = -math.radians(rotate) - (QUARTER_TURN if layout == "common" else 0.0)
    sky = Sky(radiance.contiguous(), rows_at_poles=layout == "ours", start=start)
    return LightMap(sky, int(negative.sum()))


def map_names(paths: Sequence[Path]) -> list[str]:
    """A folder name per map: its stem, preceded by its folder's name where two maps share a stem.

    Raises:
        UserError: two maps cannot be told apart, or a name cannot be that of a folder.
    """
    stems = [path.stem for path in paths]
    folders = [path.absolute().parent.name for path in paths]
    names = [
        f"{folder}-{stem}" if stems.count(stem) > 1 else stem
        for folder, stem in zip(folders, stems, strict=True)
    ]
    for path, name in zip(paths, names, strict=True):
        if names.count(name) > 1:
            raise UserError(f"{path}: two maps of this name", "rename one of them")
        if not plain_name(name):
            raise UserError(f"{path}: '{name}' cannot name a folder", "rename the map")
    return names
