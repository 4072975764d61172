"""Exposures of photographs, from EXIF or from a file that the user wrote."""

from __future__ import annotations

import json
import math
from collections.abc import Mapping, Sequence
from fractions import Fraction
from pathlib import Path

from PIL import Image

from neilfpp_method.errors import UserError

__all__ = ["LISTS", "exif_entries", "exposures_of", "photo_exposure", "read_exposures"]

EXIF_FOLDER, TIME, APERTURE, SENSITIVITY = 0x8769, 0x829A, 0x829D, 0x8827
EXIF_FORMATS = ("JPEG", "PNG", "TIFF")
"""Formats in which EXIF is looked for; most camera RAW files are TIFF files. For others, Pillow would run
parsers that nothing here needs.
"""
LISTS = ("exposures.json", "exposures.txt")
WRITE_A_LIST = f"write {LISTS[1]} beside the images: a line 'NAME SECONDS' for each"


def exposures_of(folder: Path, images: Sequence[Path], table: Path | None = None) -> Mapping[Path, float]:
    """Return the exposure of each image. Only ratios of exposures are meaningful.

    Args:
        folder: folder in which a file `exposures.json` or `exposures.txt` may lie.
        images: the files, under `folder`.
        table: such a file in another place. If there is a file, EXIF is not read.

    Raises:
        UserError: the file is malformed, or an image has no exposure.
    """
    tables = (
        [path for path in (folder / name for name in LISTS) if path.is_file()] if table is None else [table]
    )
    if tables:
        listed = read_exposures(tables[0])
        exposures = {
            image: listed.get(image.relative_to(folder).as_posix(), listed.get(image.name))
            for image in images
        }
        remedy = f"add it to {tables[0]}"
    else:
        exposures, remedy = {image: photo_exposure(image) for image in images}, WRITE_A_LIST
    for image, exposure in exposures.items():
        if exposure is None:
            raise UserError(f"{image}: no exposure time", remedy)
    return exposures


def exif_entries(path: Path) -> tuple[dict, dict]:
    """Return the EXIF entries of a file and those of its exposure sub-directory; empty if there are none."""
    try:
        with Image.open(path, formats=EXIF_FORMATS) as image:
            exif = image.getexif()
            return dict(exif), dict(exif.get_ifd(EXIF_FOLDER))
    except Exception:
        # Pillow raises many types of exceptions for unknown formats and for damaged EXIF blocks.
        return {}, {}


def photo_exposure(path: Path) -> float | None:
    """Return time · ISO/100 / f-number² from EXIF, time in seconds; None if EXIF has no usable one.

    A missing factor counts as 1, because it is constant for a lens or a camera that does not record it. An
    ISO of 0 or an f-number of 0, which adapted lenses write, counts as missing.
    """
    _, exif = exif_entries(path)
    time, aperture, sensitivity = (_positive(exif.get(tag)) for tag in (TIME, APERTURE, SENSITIVITY))
    if time is None:
        return None
    # EXIF may hold numbers whose square or product has no finite value.
    area = (aperture or 1.0) * (aperture or 1.0)
    return _positive(time * (sensitivity or 100.0) / 100.0 / area) if area else None


def _positive(entry: object) -> float | None:
    try:
        number = float(entry[0] if isinstance(entry, tuple) else entry)  # type: ignore[arg-type]
    except (TypeError, ValueError, IndexError, ZeroDivisionError):
        return None
    return number if math.isfinite(number) and number > 0 else None


def read_exposures(path: Path) -> Mapping[str, float]:
    """Read seconds by image name: a JSON object, or lines `NAME SECONDS` (also `1/60`) with `#` comments.

    Raises:
        UserError: the file is malformed, or an exposure is not a positive number.
    """
    try:
        text = path.read_text("utf-8-sig")
        if path.suffix.lower() == ".json":
            pairs = list(json.loads(text).items())
        else:
            lines = (line.split("#")[0].strip() for line in text.splitlines())
            pairs = [line.rsplit(maxsplit=1) for line in lines if line]
        listed = {name: _seconds(str(seconds)) for name, seconds in pairs}
    except (OSError, ValueError, AttributeError, ZeroDivisionError, OverflowError, RecursionError) as error:
        raise UserError(
            f"{path}: no list of exposures ({error})", "write lines 'NAME SECONDS', as 'a.jpg 1/60'"
        ) from error
    for name, seconds in listed.items():
        if not (math.isfinite(seconds) and seconds > 0):
            raise UserError(f"{path}: the exposure of {name} is {seconds}", "give seconds above 0")
    return listed


def _seconds(text: str) -> float:
    # Only quotients are given to `Fraction`: it would compute all digits of 1e999999999.
    return float(Fraction(text)) if "/" in text else float(text)
