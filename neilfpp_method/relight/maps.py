"""Read environment maps: EXR, Radiance HDR or 8-bit images, in this package's or the common layout."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

import torch

from neilfpp_method.data.files.environment_map import check_radiance
from neilfpp_method.data.files.images import image_header, read_image
from neilfpp_method.data.files.paths import plain_name
from neilfpp_method.errors import UserError
from neilfpp_method.relight.sky import Sky
from neilfpp_method.shading.color import srgb_to_linear

__all__ = ["Layout", "LightMap", "check_map", "map_names", "read_map"]

Layout = Literal["ours", "common"]

MIN_ROWS, MAX_ROWS = 4, 4096
"""Smallest and largest number of rows."""
QUARTER_TURN = math.pi / 2
"""Azimuth between both layouts: the centre of the common layout is +x with −y to its right, and the left edge
of this package's layout is +y.
"""


@dataclass(frozen=True)
class LightMap:
    """A map, and the number of slightly negative texels that were set to 0."""

    sky: Sky
    negative: int


def check_map(path: Path) -> None:
    """Check from the header of a file that it can be an environment map, without reading pixels.

    Raises:
        UserError: the file does not exist, is not an image, or has the wrong aspect ratio.
    """
    header = image_header(path)
    if not MIN_ROWS <= header.height <= MAX_ROWS:
        raise UserError(
            f"{path}: an environment map cannot have {header.height} rows",
            f"resize it to between {MIN_ROWS} and {MAX_ROWS} rows",
        )
    # A map with rows at both poles may have one row more than half of its columns.
    if abs(header.width - 2 * header.height) > 2:
        raise UserError(
            f"{path}: {header.width}×{header.height} pixels are not a latitude-longitude map",
            "give a map with twice as many columns as rows",
        )


def read_map(path: Path, layout: Layout, rotate: float = 0.0, exposure: float = 0.0) -> LightMap:
    """Read an environment map, whose vertical axis is the capture's +z.

    Args:
        path: the file. Floating-point files hold linear radiance; other images are decoded from sRGB.
        layout: "ours" (docs/light.md), or "common", the layout of Blender and most other programs, with
            rows at pixel centres.
        rotate: rotation of the light around +z, degrees, counter-clockwise seen from above.
        exposure: stops by which the light is brightened.

    Raises:
        UserError: `check_map` fails, a texel is NaN, infinite or negative, or the map is black.
    """
    check_map(path)
    file = read_image(path)
    radiance = torch.from_numpy(file.pixels)
    if not file.hdr:
        radiance = srgb_to_linear(radiance)
    check_radiance(radiance, path)
    negative = radiance < 0
    radiance = radiance.clamp_min(0).expand(-1, -1, 3) * 2.0**exposure
    if not (radiance.any() and radiance.isfinite().all()):
        raise UserError(f"{path}: the environment map is black, or overflows", "check --exposure and the map")
    start = -math.radians(rotate) - (QUARTER_TURN if layout == "common" else 0.0)
    sky = Sky(radiance.contiguous(), rows_at_poles=layout == "ours", start=start)
    return LightMap(sky, int(negative.sum()))


def map_names(paths: Sequence[Path]) -> list[str]:
    """Name the output folder of each map: its stem, preceded by the name of its folder if stems repeat.

    Raises:
        UserError: two names are equal, or a name is not valid for a folder.
    """
    stems = [path.stem for path in paths]
    folders = [path.absolute().parent.name for path in paths]
    names = [
        f"{folder}-{stem}" if stems.count(stem) > 1 else stem
        for folder, stem in zip(folders, stems, strict=True)
    ]
    for path, name in zip(paths, names, strict=True):
        if names.count(name) > 1:
            raise UserError(f"{path}: two maps have this name", "rename one of them")
        if not plain_name(name):
            raise UserError(f"{path}: '{name}' cannot name a folder", "rename the map")
    return names
