"""Exposure brackets among the photographs: each becomes one linear image, which replaces them."""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path
from typing import Literal

import numpy as np

from neilfpp_method.data.bracket_folder import GROUPS, Brackets, find_brackets, merge_brackets
from neilfpp_method.data.json_entry import Entry, write_json
from neilfpp_method.data.photo_exposure import LISTS
from neilfpp_method.errors import UserError
from neilfpp_method.prepare.photos import MIN_PHOTOS, Photos, check_names
from neilfpp_method.prepare.progress import Bar, Bars
from neilfpp_method.prepare.steps import Step, begin, stamp

__all__ = ["Merged", "brackets_among", "merge_photos"]

IMAGES, VALID, MOVED = "images", "valid", "moved.json"
SAME_STEP = 0.2
"""In stops: what EXIF rounds an exposure to is off by less."""
AS_THEY_ARE = "or take the photographs as they are: --brackets off"


def brackets_among(photos: Photos, wanted: Literal["auto", "off"]) -> Brackets | None:
    """The brackets that the photographs are; none where they are single pictures.

    A list of brackets or of exposures beside the photographs says that they are brackets. Without one they
    are where `find_brackets` puts every one of them into a bracket, there are enough poses, and all brackets
    have the same steps: exposures that the camera chose for each picture do not. A bracket with a photograph
    that cannot be read is left out.

    Raises:
        UserError: there is a list, and the photographs are no brackets, or too few.
    """
    if wanted == "off":
        return None
    listed = next((photos.root / name for name in (GROUPS, *LISTS) if (photos.root / name).is_file()), None)
    try:
        found = find_brackets(photos.root, unreadable=photos.unreadable)
        check_names(tuple(found), tuple(next(iter(bracket)) for bracket in found.values()))
    except UserError as error:
        if listed is None:
            return None
        raise UserError(error.problem, f"{error.remedy}, {AS_THEY_ARE}") from error
    photographs = {photo.path for photo in photos.items}
    used = {path for bracket in found.values() for path in bracket if path not in photos.unreadable}
    found = {
        name: bracket
        for name, bracket in found.items()
        if not any(path in photos.unreadable for path in bracket)
    }
    if listed is not None:
        if strange := sorted(used - photographs):
            raise UserError(f"{listed}: {strange[0]} is no photograph that can be read", "correct the list")
        if len(found) < MIN_PHOTOS:
            problem = f"{listed}: {len(found)} bracket{'s' * (len(found) != 1)}"
            raise UserError(
                problem, f"give at least {MIN_PHOTOS}, better 30, from all around the object, {AS_THEY_ARE}"
            )
        return found
    return found if used == photographs and len(found) >= MIN_PHOTOS and _same_steps(found) else None


def _same_steps(brackets: Brackets) -> bool:
    stops = [np.log2(sorted(bracket.values())) for bracket in brackets.values()]
    steps = [np.diff(values) for values in stops]
    return all(len(s) == len(steps[0]) and np.abs(s - steps[0]).max() < SAME_STEP for s in steps)


@dataclass(frozen=True)
class Merged:
    """The merged images in the place of the photographs, the step that made them, and what it came to."""

    photos: Photos
    step: Step
    remark: str


def merge_photos(
    photos: Photos,
    brackets: Brackets,
    response: Literal["auto", "linear", "srgb"],
    folder: Path,
    open_bar: Bars,
) -> Merged:
    """Merge brackets, as a step.

    The camera and focal length of a merged image are those that EXIF names in its middle exposure.

    Args:
        photos: the photographs; those that are in no bracket are left out.
        brackets: by `brackets_among`.
        response: what the photographs' pixels are; auto: calibrated, or linear for camera RAW.
        folder: the step's folder.
        open_bar: for the progress.

    Raises:
        UserError: as `merge_brackets`.
    """
    exposures = {name: list(bracket.values()) for name, bracket in brackets.items()}
    used = [path for bracket in brackets.values() for path in bracket]
    step = begin(folder, photos=stamp(used, photos.root), brackets=exposures, response=response)
    if step.result is None:
        moved = _merge(brackets, folder, response, open_bar("merging brackets", len(brackets)))
        step = replace(step, result=step.complete({"moved": moved}))
    by_path = {photo.path: photo for photo in photos.items}
    items = []
    for name, bracket in brackets.items():
        middle = by_path[sorted(bracket, key=lambda path, of=bracket: of[path])[len(bracket) // 2]]
        files = {"path": folder / IMAGES / f"{name}.exr", "valid": folder / VALID / f"{name}.png"}
        items.append(replace(middle, name=name, folder=".", exposure=None, **files))
    remark = f"{len(used)} photographs in {len(brackets)} exposure brackets became {len(items)} linear images"
    if unused := len(photos.items) - len(set(used)):
        remark += f"; {unused} in no bracket left out"
    if by_hand := [shift for shift in step.result["moved"].values() if shift]:
        remark += f"; taken by hand: those of {len(by_hand)} were moved onto one another, "
        remark += f"by up to {max(by_hand):.1f} pixels"
    return Merged(replace(photos, root=folder, items=tuple(items), linear=True), step, remark)


def _merge(
    brackets: Brackets, folder: Path, response: Literal["auto", "linear", "srgb"], bar: Bar
) -> dict[str, float]:
    """Merge the remaining brackets; returns each pose's largest shift in pixels, earlier ones included."""
    known = folder / MOVED
    moved = dict(Entry.load(known).entries()) if known.is_file() else {}

    def done(name: str, shift: float | None) -> None:
        if shift is not None:
            moved[name] = shift
            write_json(known, moved)
        bar.advance()

    merge_brackets(brackets, folder / IMAGES, folder / VALID, response, done)
    return moved
