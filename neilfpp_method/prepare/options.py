"""Options of the command `neilfpp prepare`."""

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
    """Folder of photographs, with its sub-folders. If it is a capture with poses, the poses are kept."""
    out: Path
    """Folder of the capture. Finished steps are kept in its sub-folder work, so a stopped command
    continues."""
    matching: Literal["auto", "exhaustive", "sequential", "vocabulary"] = "auto"
    """Pairs of images to match: all, neighbours in the order of the names, or similar images; auto: all pairs
    of up to 200 images, similar images of more.
    """
    cameras: Literal["auto", "shared", "folder", "image"] = "auto"
    """Images that share focal length and distortion: all, those of a folder, or none; auto: those of the same
    size, camera and focal length (EXIF).
    """
    camera_model: Literal[
        "SIMPLE_PINHOLE", "PINHOLE", "SIMPLE_RADIAL", "RADIAL", "OPENCV", "OPENCV_FISHEYE"
    ] = "SIMPLE_RADIAL"
    """COLMAP camera model whose parameters are estimated."""
    response: Literal["auto", "linear", "srgb"] = "auto"
    """Pixel values are linear radiance (HDR) or sRGB (LDR); auto: floating-point and RAW files are linear."""
    brackets: Literal["auto", "off"] = "auto"
    """Merging of exposure brackets into linear images; auto: if all photographs belong to brackets."""
    undistort: bool = False
    """Resample images to pinhole cameras; otherwise images are unchanged and cameras keep their lens."""
    cloud: Literal["auto", "dense", "sparse"] = "auto"
    """The oriented points that training keeps the surface to. dense: computed from all images by plane-sweep
    stereo, on the CPU. sparse: the points of structure from motion, or of the capture. auto: the points of a
    capture that has some with normals, otherwise dense, and sparse if stereo finds no surface.
    """
    test_every: int | None = None
    """Hold out every k-th view for testing, 0: none; default: the split of the capture, or every 8th view."""
    auto: bool = False
    """Leave out the views that `neilfpp inspect` rejects: black views, blurred views and duplicates."""
    allow_partial: bool = False
    """Leave out images that cannot be read or placed, whatever their number."""
    also: tuple[Literal["nerfstudio", "neilf"], ...] = ()
    """Other formats to write as well, into the folders CAPTURE/nerfstudio and CAPTURE/neilf."""
