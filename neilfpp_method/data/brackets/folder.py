"""Find the exposure brackets of a folder and merge each of them into a linear EXR image."""

from __future__ import annotations

import json
import math
import re
from collections import Counter, defaultdict
from collections.abc import Callable, Collection, Mapping, Sequence
from pathlib import Path
from typing import Literal

import numpy as np
from jaxtyping import Float32

from neilfpp_method.data.brackets.alignment import Aligned, align
from neilfpp_method.data.brackets.merging import (
    Bracket,
    Response,
    calibrate,
    linear_response,
    merge,
    srgb_response,
)
from neilfpp_method.data.brackets.photo_exposure import exposures_of
from neilfpp_method.data.files.images import IMAGE_SUFFIXES, read_image, write_exr, write_png
from neilfpp_method.data.files.paths import inside
from neilfpp_method.data.files.raw import RAW_SUFFIXES, check_not_raw, develop
from neilfpp_method.errors import UserError

__all__ = ["GROUPS", "Brackets", "find_brackets", "merge_brackets"]

Brackets = Mapping[str, Mapping[Path, float]]
"""For each pose, by name, its images with their exposures."""

GROUPS = "brackets.json"
"""File that lists the images of each pose."""

NUMBERED = re.compile(r"[_-]\d+$")
"""Number at the end of a name, NAME_0 or NAME-0."""

MAX_CALIBRATION_BRACKETS = 6
"""Largest number of brackets from which a response is calibrated."""
CALIBRATION_SIDE = 1024
"""Longest side of the images for the calibration of a response, in pixels; bounds the memory."""


def find_brackets(folder: Path, exposures: Path | None = None, unreadable: Collection[Path] = ()) -> Brackets:
    """Find the brackets of a folder.

    Images belong to one bracket if `brackets.json` lists them together ({"pose": ["a.jpg", "b.jpg"]}), if
    they lie in one sub-folder, if their names are NAME_0, NAME_1, …, or if, in the order of the names, the
    exposures repeat with a fixed period.

    Args:
        folder: the folder of the images.
        exposures: a file of exposures, as `exposures_of` reads it; if None, the file beside the images, or
            EXIF.
        unreadable: images that are known to be damaged. They stay in their brackets, with the exposure NaN,
            so that the caller can identify the brackets that they spoil.

    Raises:
        UserError: there are no brackets, an image has no exposure, or two images of a bracket have the same
            one.
    """
    listed = _listed_groups(folder, unreadable)
    images = [image for group in listed.values() for image in group]
    if not images:
        raise UserError(f"{folder}: no images", f"one of {', '.join((*IMAGE_SUFFIXES, *RAW_SUFFIXES))}")
    exposure_of = exposures_of(folder, [image for image in images if image not in unreadable], exposures)
    listed = {name: group for name, group in listed.items() if any(image in exposure_of for image in group)}
    by_name = images[0].parent == folder and not (folder / GROUPS).is_file()
    guess = by_name and not all(_is_bracket(group, exposure_of) for group in listed.values())
    groups = _returning_groups(images, exposure_of) if guess else listed
    for name, group in groups.items():
        if not _is_bracket(group, exposure_of):
            raise UserError(
                f"{folder}: the {len(group)} images of '{name}' are not a bracket: their exposures do not "
                "all differ",
                f"put each pose in a folder of its own, or list the poses in {GROUPS}",
            )
    return {
        name: {image: exposure_of.get(image, math.nan) for image in group} for name, group in groups.items()
    }


def _listed_groups(folder: Path, unreadable: Collection[Path]) -> Mapping[str, Sequence[Path]]:
    """Groups by `brackets.json`, by names that differ only in a number, or by sub-folders."""
    path = folder / GROUPS
    if path.is_file():
        try:
            named = {
                str(name): [folder / file for file in files]
                for name, files in json.loads(path.read_text("utf-8-sig")).items()
            }
        except (OSError, ValueError, TypeError, AttributeError, RecursionError) as error:
            raise UserError(
                f"{path}: no list of brackets ({error})", 'write {"pose": ["a.jpg", "b.jpg"]}'
            ) from error
        for name in named:
            if Path(name).name != name or name.startswith("."):
                raise UserError(
                    f"{path}: a pose cannot be called {name!r}", "give it the name of a file without suffix"
                )
        for image in (image for group in named.values() for image in group):
            if not inside(folder, image).is_file():
                raise UserError(f"{path}: there is no {image}", "correct the list")
        return named
    groups: dict[str, list[Path]] = defaultdict(list)
    for image in _images(folder):
        groups[NUMBERED.sub("", image.stem)].append(image)
    if any(image not in unreadable for group in groups.values() for image in group):
        return groups
    folders = sorted(path for path in folder.iterdir() if path.is_dir() and not path.name.startswith("."))
    return {path.name: images for path in folders if (images := _images(path))}


def _images(folder: Path) -> list[Path]:
    suffixes = {*IMAGE_SUFFIXES, *RAW_SUFFIXES}
    return sorted(p for p in folder.iterdir() if p.suffix.lower() in suffixes and not p.name.startswith("."))


def _returning_groups(
    images: Sequence[Path], exposures: Mapping[Path, float]
) -> Mapping[str, Sequence[Path]]:
    """Groups by the shortest period with which the exposures repeat; one group if they do not repeat."""

    def repeats(n: int) -> bool:
        return all(len(set(_recorded_exposures(images[k::n], exposures))) <= 1 for k in range(n))

    period = next(n for n in range(1, len(images) + 1) if len(images) % n == 0 and repeats(n))
    return {images[i].stem: images[i : i + period] for i in range(0, len(images), period)}


def _is_bracket(images: Sequence[Path], exposures: Mapping[Path, float]) -> bool:
    recorded = _recorded_exposures(images, exposures)
    return len(images) >= 2 and len(set(recorded)) == len(recorded)


def _recorded_exposures(images: Sequence[Path], exposures: Mapping[Path, float]) -> list[float]:
    return [exposures[image] for image in images if image in exposures]


def merge_brackets(
    brackets: Brackets,
    images: Path,
    valid: Path,
    response: Literal["auto", "linear", "srgb"] = "auto",
    on_merged: Callable[[str, float | None], None] = lambda name, moved: None,
) -> None:
    """Merge each bracket into a linear image `images/NAME.exr` and a validity mask `valid/NAME.png`.

    All images have the same radiance scale, in which 1 is about the white of the middle exposure. Hand-held
    photographs are aligned with the middle one. A pose whose two files exist already is skipped, so that an
    interrupted call can be repeated.

    Args:
        brackets: the result of `find_brackets`.
        images: folder of the merged images.
        valid: folder of the validity masks, which are white where radiance is known.
        response: response curve of the pixels; "auto": linear for camera RAW, else calibrated from the
            brackets.
        on_merged: called when the files of a pose exist, with its name and the largest motion of its
            photographs in pixels, which is None if the pose was skipped.

    Raises:
        UserError: an image cannot be read; the images of a pose differ in size; the response of camera RAW is
            given as sRGB; or the response cannot be calibrated.
    """
    middle = float(np.median([exposure for bracket in brackets.values() for exposure in bracket.values()]))
    decode = _response(brackets, response)
    for name, bracket in brackets.items():
        image, mask = images / f"{name}.exr", valid / f"{name}.png"
        moved = None
        if not (image.is_file() and mask.is_file()):
            aligned = _read(bracket, middle)
            merged = merge(aligned.bracket, decode)
            write_exr(image, {"RGB": merged.radiance})
            write_png(mask, np.where(merged.valid, 255, 0).astype(np.uint8))
            moved = aligned.moved
        on_merged(name, moved)


def _response(brackets: Brackets, response: Literal["auto", "linear", "srgb"]) -> Response:
    images = [image for bracket in brackets.values() for image in bracket]
    raw = [image for image in images if image.suffix.lower() in RAW_SUFFIXES]
    if response == "srgb":
        check_not_raw(raw)
        return srgb_response
    if response == "linear" or len(raw) == len(images):
        return linear_response
    if raw:
        raise UserError(
            f"{raw[0]} is camera RAW, and other images of the folder are not", "keep images of one kind"
        )
    alike = Counter(tuple(bracket.values()) for bracket in brackets.values()).most_common(1)[0][0]
    usable = [bracket for bracket in brackets.values() if tuple(bracket.values()) == alike]
    step = -(-len(usable) // MAX_CALIBRATION_BRACKETS)
    return calibrate([_thin(_read(bracket, 1.0).bracket) for bracket in usable[::step]])


def _thin(bracket: Bracket) -> Bracket:
    """A subset of the pixels for the calibration: all photographs together may not fit into memory."""
    step = -(-max(bracket.pixels[0].shape[:2]) // CALIBRATION_SIDE)
    return Bracket(tuple(pixels[::step, ::step].copy() for pixels in bracket.pixels), bracket.exposures)


def _read(bracket: Mapping[Path, float], unit: float) -> Aligned:
    """Read and align the images of a bracket, with exposures relative to `unit`."""
    frames = {path: _frame(path) for path in bracket}
    first = next(iter(frames))
    for path, frame in frames.items():
        if frame.shape != frames[first].shape:
            raise UserError(
                f"{path}: another size than {first.name}", "do not crop or turn single images of a bracket"
            )
    return align(Bracket(tuple(frames.values()), tuple(exposure / unit for exposure in bracket.values())))


def _frame(path: Path) -> Float32[np.ndarray, "H W 3"]:
    if path.suffix.lower() in RAW_SUFFIXES:
        developed = develop(path)
        return np.where(developed.valid[..., None], developed.pixels, np.float32(1.0))
    image = read_image(path)
    if image.hdr:
        raise UserError(f"{path}: holds linear radiance already", "use it as it is; merge photographs only")
    return image.pixels if image.pixels.shape[2] == 3 else image.pixels.repeat(3, axis=2)
