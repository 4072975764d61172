"""The photographs of a folder: files, names, and what their headers and EXIF entries say."""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Literal

import numpy as np
from jaxtyping import Bool, Float32
from PIL import Image

from neilfpp_method.data.formats.places import view_names
from neilfpp_method.data.images import IMAGE_SUFFIXES, image_header, read_image
from neilfpp_method.data.photo_exposure import photo_exposure
from neilfpp_method.data.raw import RAW_SUFFIXES, develop
from neilfpp_method.data.views import plain_name
from neilfpp_method.errors import UserError

__all__ = ["MIN_PHOTOS", "Photo", "Photos", "Picture", "check_names", "read_photo", "survey", "unreadable"]

MIN_PHOTOS = 3
EXIF_FOLDER, MAKE, MODEL, ORIENTATION, FOCAL, FOCAL_35MM = 0x8769, 0x010F, 0x0110, 0x0112, 0x920A, 0xA405
FILM_WIDTH = 36.0


@dataclass(frozen=True)
class Photo:
    """A photograph that is to become a view.

    `exposure` is the light that the picture took in, relative to the others, where EXIF says it. `device`
    names camera and focal length as far as EXIF does, `focal` is the focal length in units of the image's
    longer side. `held` is EXIF's orientation: pixels stay as the sensor has them, but it tells which way is
    up. `valid` is a validity mask, where there is one.
    """

    name: str
    path: Path
    folder: str
    exposure: float | None
    device: str
    focal: float | None
    held: int = 1
    valid: Path | None = None


@dataclass(frozen=True)
class Photos:
    """A folder's photographs in path order, all of one kind. `unreadable`: what is wrong with others."""

    root: Path
    items: tuple[Photo, ...]
    linear: bool
    unreadable: Mapping[Path, str] = field(default_factory=dict)


@dataclass(frozen=True)
class Picture:
    """The pixels of a photograph: linear radiance, or display values in [0, 1].

    `valid` is false where a pixel means nothing: saturated in a RAW file, or not a finite number ≥ 0 (these
    are 0). `alpha` in [0, 1] is the object's mask where the file has one.
    """

    pixels: Float32[np.ndarray, "H W 3"]
    valid: Bool[np.ndarray, "H W"]
    alpha: Float32[np.ndarray, "H W"] | None


def survey(root: Path, response: Literal["auto", "linear", "srgb"]) -> Photos:
    """Find the photographs under a folder and read their headers; hidden and other files are skipped.

    Args:
        root: the folder.
        response: what the pixels are; auto: floating-point and RAW files are linear.

    Raises:
        UserError: no such folder, too few images, two of the same name, or two kinds.
    """
    if not root.is_dir():
        raise UserError(f"{root}: no such folder", "give a folder of photographs")
    paths = sorted(path for path in root.rglob("*") if _is_photo(path, root))
    kinds: dict[Path, bool] = {}
    problems: dict[Path, str] = {}
    for path in paths:
        try:
            kinds[path] = path.suffix.lower() in RAW_SUFFIXES or image_header(path).hdr
        except UserError as error:
            problems[path] = error.problem
    if len(kinds) < MIN_PHOTOS:
        count = f"{len(kinds) or 'no'} image{'s' * (len(kinds) != 1)}"
        also = (
            f", and {len(problems)} that cannot be read ({next(iter(problems.values()))})" if problems else ""
        )
        raise UserError(
            f"{root}: {count}{also}", f"give at least {MIN_PHOTOS}, better 30, from all around the object"
        )
    if response == "auto" and len(set(kinds.values())) > 1:
        hdr, ldr = (next(path for path, kind in kinds.items() if kind is wanted) for wanted in (True, False))
        raise UserError(f"{hdr} is linear and {ldr} is not", "keep images of one kind, or give --response")
    linear = next(iter(kinds.values())) if response == "auto" else response == "linear"
    names = view_names([path.relative_to(root).as_posix() for path in kinds])
    check_names(names, tuple(kinds))
    items = tuple(_photo(root, name, path, linear) for name, path in zip(names, kinds, strict=True))
    return Photos(root, items, linear, problems)


def unreadable(problems: Sequence[str]) -> UserError:
    """One error for all images that cannot be read."""
    more = f" (and {len(problems) - 1} more such images)" if len(problems) > 1 else ""
    return UserError(
        f"{problems[0]}{more}", "export the image again or remove it, or leave it out with --allow-partial"
    )


def read_photo(path: Path) -> Picture:
    """Decode a photograph.

    Raises:
        UserError: as `read_image` and `develop`.
    """
    if path.suffix.lower() in RAW_SUFFIXES:
        developed = develop(path)
        return Picture(developed.pixels, developed.valid, None)
    image = read_image(path)
    pixels = np.repeat(image.pixels, 3, axis=2) if image.pixels.shape[2] == 1 else image.pixels
    usable = (np.isfinite(pixels) & (pixels >= 0)).all(axis=2)
    return Picture(np.where(usable[..., None], pixels, np.float32(0)), usable, image.alpha)


def _is_photo(path: Path, root: Path) -> bool:
    hidden = any(part.startswith(".") for part in path.relative_to(root).parts)
    return not hidden and path.suffix.lower() in IMAGE_SUFFIXES + RAW_SUFFIXES and path.is_file()


def check_names(names: Sequence[str], paths: Sequence[Path]) -> None:
    """Refuse names of views that two of the files would share, or that cannot name a file everywhere.

    Raises:
        UserError: names the files.
    """
    often = Counter(names)
    for name, path in zip(names, paths, strict=True):
        if often[name] > 1:
            twins = " and ".join(str(other) for n, other in zip(names, paths, strict=True) if n == name)
            raise UserError(f"{twins} would both be named '{name}'", "keep or rename one of them")
        if not plain_name(name):
            raise UserError(f"{path}: '{name}' cannot name a file everywhere", "rename the image")


def _photo(root: Path, name: str, path: Path, linear: bool) -> Photo:
    entries, details = _exif(path)
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
        focal=focal_35mm and focal_35mm / FILM_WIDTH,
        held=int(_number(entries.get(ORIENTATION)) or 1),
    )


def _exif(path: Path) -> tuple[dict, dict]:
    """The entries of a file, and those about the exposure; empty where Pillow finds none."""
    try:
        with Image.open(path) as image:
            exif = image.getexif()
            return dict(exif), dict(exif.get_ifd(EXIF_FOLDER))
    except Exception:  # formats that Pillow does not know, and EXIF blocks that are damaged
        return {}, {}


def _number(entry: object) -> float | None:
    try:
        number = float(entry)  # type: ignore[arg-type]
    except (TypeError, ValueError, ZeroDivisionError):
        return None
    return number if np.isfinite(number) and number > 0 else None
