"""Find the photographs of a folder and read their headers, EXIF entries and pixels."""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Literal

import numpy as np
from jaxtyping import Bool, Float32

from neilfpp_method.data.brackets.photo_exposure import exif_entries, photo_exposure
from neilfpp_method.data.files.images import IMAGE_SUFFIXES, UNREAD_SUFFIXES, image_header, read_image
from neilfpp_method.data.files.paths import plain_name
from neilfpp_method.data.files.raw import RAW_SUFFIXES, check_not_raw, develop
from neilfpp_method.data.formats.places import view_names
from neilfpp_method.errors import UserError

__all__ = [
    "MIN_PHOTOS",
    "DecodedPhoto",
    "Photo",
    "Photos",
    "check_names",
    "read_photo",
    "survey",
    "unreadable",
]

MIN_PHOTOS = 3
"""Smallest number of photographs with which structure from motion is attempted."""

MAKE, MODEL, ORIENTATION, FOCAL, FOCAL_35MM = 0x010F, 0x0110, 0x0112, 0x920A, 0xA405
"""EXIF tags: manufacturer, model, orientation, focal length in millimetres, and the equivalent focal length
on 35 mm film."""

VIDEO_SUFFIXES = (".mp4", ".mov", ".m4v", ".avi", ".mkv", ".webm")
"""Suffixes of videos, which are skipped."""

FILM_WIDTH = 36.0
"""Longer side of a frame of 35 mm film, in millimetres."""

FOCAL_RANGE = 1.0, 10_000.0
"""Smallest and largest equivalent focal length that a lens can have, in millimetres; others are ignored."""


@dataclass(frozen=True)
class Photo:
    """The file of a photograph and the contents of its header.

    Attributes:
        name: name of the view that the photograph becomes.
        path: the file.
        folder: folder of the file, relative to the folder of all photographs.
        exposure: exposure by EXIF (see `photo_exposure`), if pixels are linear; None if it is unknown.
        device: manufacturer, model and focal length by EXIF, in one text; empty if unknown.
        focal: focal length by EXIF, in units of the longer side of the image; None if unknown.
        orientation: EXIF orientation, 1 to 8. Pixels are not rotated by it; it is used to find the up
            direction.
        valid: validity mask; None if all pixels are valid.
    """

    name: str
    path: Path
    folder: str
    exposure: float | None
    device: str
    focal: float | None
    orientation: int = 1
    valid: Path | None = None


@dataclass(frozen=True)
class Photos:
    """The photographs of a folder.

    Attributes:
        root: the folder.
        items: the photographs, in the order of their paths.
        linear: whether pixels are linear radiance; the same for all photographs.
        unreadable: for each file that cannot be read, what is wrong with it.
    """

    root: Path
    items: tuple[Photo, ...]
    linear: bool
    unreadable: Mapping[Path, str] = field(default_factory=dict)


@dataclass(frozen=True)
class DecodedPhoto:
    """The decoded pixels of a photograph.

    Attributes:
        pixels: linear radiance, or display values in [0, 1]. Invalid numbers are replaced by 0.
        valid: false at pixels that are saturated in a RAW file, negative, or not finite.
        alpha: alpha channel in [0, 1], the mask of the object; None if the file has none.
    """

    pixels: Float32[np.ndarray, "H W 3"]
    valid: Bool[np.ndarray, "H W"]
    alpha: Float32[np.ndarray, "H W"] | None


def survey(root: Path, response: Literal["auto", "linear", "srgb"]) -> Photos:
    """Find the photographs in a folder and its sub-folders and read their headers.

    Hidden files and files that are not images are skipped.

    Args:
        root: the folder.
        response: meaning of pixel values; "auto": floating-point and RAW files are linear.

    Raises:
        UserError: the folder does not exist, has too few images, has images of the same name, has both linear
            images and images with display values, or has camera RAW whose response is given as sRGB.
    """
    if not root.is_dir():
        problem = "is a file, not a folder" if root.exists() else "no such folder"
        raise UserError(f"{root}: {problem}", "give a folder of photographs")
    paths = sorted(path for path in root.rglob("*") if _is_photo(path, root))
    is_linear: dict[Path, bool] = {}
    problems: dict[Path, str] = {}
    for path in paths:
        try:
            is_linear[path] = path.suffix.lower() in RAW_SUFFIXES or image_header(path).hdr
        except UserError as error:
            problems[path] = error.problem
    if len(is_linear) < MIN_PHOTOS:
        message = f"{root}: {len(is_linear) or 'no'} image{'s' * (len(is_linear) != 1)}"
        if problems:
            message += f", and {len(problems)} that cannot be read ({next(iter(problems.values()))})"
        video = next((path for path in root.rglob("*") if path.suffix.lower() in VIDEO_SUFFIXES), None)
        frames = f", for example frames of {video.name} (ffmpeg -i VIDEO -r 2 %04d.png)" if video else ""
        wanted = f"give at least {MIN_PHOTOS}, better 30, from all around the object"
        raise UserError(message, wanted + frames)
    if response == "auto" and len(set(is_linear.values())) > 1:
        hdr, ldr = (next(path for path in is_linear if is_linear[path] is kind) for kind in (True, False))
        raise UserError(f"{hdr} is linear and {ldr} is not", "keep images of one kind, or give --response")
    if response == "srgb":
        check_not_raw(list(is_linear))
    linear = next(iter(is_linear.values())) if response == "auto" else response == "linear"
    names = view_names([path.relative_to(root).as_posix() for path in is_linear])
    check_names(names, tuple(is_linear))
    items = tuple(_photo(root, name, path, linear) for name, path in zip(names, is_linear, strict=True))
    return Photos(root, items, linear, problems)


def unreadable(problems: Sequence[str]) -> UserError:
    """Return one error for all images that cannot be read."""
    more = f" (and {len(problems) - 1} more such images)" if len(problems) > 1 else ""
    return UserError(
        f"{problems[0]}{more}", "export the image again or remove it, or leave it out with --allow-partial"
    )


def read_photo(path: Path) -> DecodedPhoto:
    """Decode a photograph.

    Raises:
        UserError: as `read_image` and `develop`.
    """
    if path.suffix.lower() in RAW_SUFFIXES:
        developed = develop(path)
        return DecodedPhoto(developed.pixels, developed.valid, None)
    image = read_image(path)
    pixels = np.repeat(image.pixels, 3, axis=2) if image.pixels.shape[2] == 1 else image.pixels
    usable = (np.isfinite(pixels) & (pixels >= 0)).all(axis=2)
    return DecodedPhoto(np.where(usable[..., None], pixels, np.float32(0)), usable, image.alpha)


def _is_photo(path: Path, root: Path) -> bool:
    hidden = any(part.startswith(".") for part in path.relative_to(root).parts)
    # Photographs in formats that are not read count as unreadable instead of being skipped.
    suffixes = (*IMAGE_SUFFIXES, *RAW_SUFFIXES, *UNREAD_SUFFIXES)
    return not hidden and path.suffix.lower() in suffixes and path.is_file()


def check_names(names: Sequence[str], paths: Sequence[Path]) -> None:
    """Check that the names of views are unique and valid file names on all operating systems.

    Args:
        names: names of the views.
        paths: their files, for the message.

    Raises:
        UserError: two files have the same name, or a name is not a valid file name.
    """
    counts = Counter(names)
    for name, path in zip(names, paths, strict=True):
        if counts[name] > 1:
            twins = " and ".join(str(other) for n, other in zip(names, paths, strict=True) if n == name)
            raise UserError(f"{twins} would both be named '{name}'", "keep or rename one of them")
        if not plain_name(name):
            raise UserError(f"{path}: '{name}' is not a valid file name on all systems", "rename the image")


def _photo(root: Path, name: str, path: Path, linear: bool) -> Photo:
    entries, details = exif_entries(path)
    low, high = FOCAL_RANGE
    focal_35mm, focal = (_number(details.get(tag)) for tag in (FOCAL_35MM, FOCAL))
    device = " ".join(
        str(part).strip() for part in (entries.get(MAKE), entries.get(MODEL), focal or focal_35mm) if part
    )
    return Photo(
        name=name,
        path=path,
        folder=path.parent.relative_to(root).as_posix(),
        exposure=photo_exposure(path) if linear else None,
        device=device,
        focal=focal_35mm / FILM_WIDTH if focal_35mm and low <= focal_35mm <= high else None,
        orientation=int(_number(entries.get(ORIENTATION)) or 1),
    )


def _number(entry: object) -> float | None:
    """A positive, finite number; None if the entry is something else."""
    try:
        number = float(entry)  # type: ignore[arg-type]
    except (TypeError, ValueError, ZeroDivisionError):
        return None
    return number if np.isfinite(number) and number > 0 else None
