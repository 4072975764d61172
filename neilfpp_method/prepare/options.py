"""What `neilfpp prepare` can be asked for."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Literal

import tyro

__all__ = ["Prepare"]


@dataclass(frozen=True)
class Prepare:
    """Make a capture from a folder of photographs: poses, scene box and oriented points."""

    images: tyro.conf.Positional[Path]
    """The folder of photographs; sub-folders count. A capture with poses keeps them."""
    out: Path
    """The capture's folder. Finished steps are kept in its folder work, so a stopped command continues."""
    matching: Literal["auto", "exhaustive", "sequential", "vocabulary"] = "auto"
    """Which pairs are compared: all, neighbours in the order of the names, or look-alikes; auto: all up to
    200 images, look-alikes beyond.
    """
    cameras: Literal["auto", "shared", "folder", "image"] = "auto"
    """Which images share focal length and distortion: all, those of a folder, or none; auto: those of one
    size, camera and focal length in EXIF.
    """
    camera_model: Literal[
        "SIMPLE_PINHOLE", "PINHOLE", "SIMPLE_RADIAL", "RADIAL", "OPENCV", "OPENCV_FISHEYE"
    ] = "SIMPLE_RADIAL"
    """COLMAP's model of the lens that is estimated."""
    response: Literal["auto", "linear", "srgb"] = "auto"
    """Pixels are linear radiance (HDR) or sRGB (LDR); auto: floating-point and RAW files are linear."""
    brackets: Literal["auto", "off"] = "auto"
    """Merge exposure brackets into linear images first; auto: where the folder is one of brackets."""
    undistort: bool = False
    """Resample images to pinhole cameras; otherwise pixels stay as they are and cameras keep their lens."""
    dense: bool = False
    """Compute a dense oriented cloud by plane-sweep stereo; otherwise the sparse points are used."""
    test_every: int | None = None
    """Hold out every k-th view for testing, 0 none; by default the poses' own split, or every 8th."""
    auto: bool = False
    """Leave out the views that `neilfpp inspect` rejects: black or blurred ones, and duplicates."""
    allow_partial: bool = False
    """Leave out images that cannot be read or placed, however many."""
    also: tuple[Literal["nerfstudio", "neilf"], ...] = ()
    """Other formats to write into the folders CAPTURE/nerfstudio and CAPTURE/neilf."""
