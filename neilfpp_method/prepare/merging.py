"""Merging of exposure brackets: one linear image takes the place of the photographs of each bracket."""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path
from typing import Literal

import numpy as np

from neilfpp_method.data.brackets.folder import GROUPS, Brackets, find_brackets, merge_brackets
from neilfpp_method.data.brackets.photo_exposure import LISTS
from neilfpp_method.data.files.json_entry import Entry, write_json
from neilfpp_method.errors import UserError
from neilfpp_method.prepare.photos import MIN_PHOTOS, Photos, check_names
from neilfpp_method.prepare.progress import Bar, Bars
from neilfpp_method.prepare.steps import Step, begin, stamp

__all__ = ["MergedPhotos", "brackets_among", "merge_photos"]

IMAGES, VALID = "images", "valid"
"""Folders of the merged images and of their validity masks, inside the folder of the step."""

SHIFTS = "moved.json"
"""File with the shift of each bracket that is merged already, so that an interrupted step can continue."""

STEP_TOLERANCE = 0.2
"""Largest difference between exposure steps that count as equal, in stops; EXIF rounds by less than that."""

BRACKETS_OFF = "or use the photographs as single images: --brackets off"


def brackets_among(photos: Photos, wanted: Literal["auto", "off"]) -> Brackets | None:
    """Find the exposure brackets among the photographs.

    If a list of brackets or of exposures lies beside the photographs, they are brackets. Without a list they
    are brackets if `find_brackets` assigns every photograph to a bracket, if there are at least `MIN_PHOTOS`
    brackets, and if all brackets have the same exposure steps; automatic exposures of single images differ
    irregularly. A bracket with an unreadable photograph is left out.

    Args:
        photos: the photographs of the folder.
        wanted: the option `--brackets`.

    Returns:
        The brackets by name; None if the photographs are single images.

    Raises:
        UserError: there is a list, but the photographs do not match it or make too few brackets.
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
        raise UserError(error.problem, f"{error.remedy}, {BRACKETS_OFF}") from error
    photographs = {photo.path for photo in photos.items}
    used = {path for bracket in found.values() for path in bracket if path not in photos.unreadable}
    found = {
        name: bracket
        for name, bracket in found.items()
        if not any(path in photos.unreadable for path in bracket)
    }
    if listed is not None:
        if unknown := sorted(used - photographs):
            raise UserError(f"{listed}: {unknown[0]} is not a readable photograph", "correct the list")
        if len(found) < MIN_PHOTOS:
            problem = f"{listed}: {len(found)} bracket{'s' * (len(found) != 1)}"
            raise UserError(
                problem, f"give at least {MIN_PHOTOS}, better 30, from all around the object, {BRACKETS_OFF}"
            )
        return found
    return found if used == photographs and len(found) >= MIN_PHOTOS and _same_steps(found) else None


def _same_steps(brackets: Brackets) -> bool:
    """Whether the exposures of all brackets differ by the same steps."""
    stops = [np.log2(sorted(bracket.values())) for bracket in brackets.values()]
    steps = [np.diff(values) for values in stops]
    return all(len(s) == len(steps[0]) and np.abs(s - steps[0]).max() < STEP_TOLERANCE for s in steps)


@dataclass(frozen=True)
class MergedPhotos:
    """Merged images, in place of the photographs.

    Attributes:
        photos: the merged images.
        step: the step that made them.
        remark: a note for the summary: numbers of photographs and images, and shifts.
    """

    photos: Photos
    step: Step
    remark: str


def merge_photos(
    photos: Photos,
    brackets: Brackets,
    response: Literal["auto", "linear", "srgb"],
    folder: Path,
    open_bar: Bars,
) -> MergedPhotos:
    """Merge exposure brackets into linear images.

    A merged image has the camera and the focal length that EXIF gives for its middle exposure.

    Args:
        photos: the photographs; those in no bracket are left out.
        brackets: the result of `brackets_among`.
        response: response curve of the photographs; "auto" calibrates it, or takes camera RAW as linear.
        folder: folder of the step.
        open_bar: opens a progress bar.

    Raises:
        UserError: as `merge_brackets`.
    """
    exposures = {name: list(bracket.values()) for name, bracket in brackets.items()}
    used = [path for bracket in brackets.values() for path in bracket]
    step = begin(folder, photos=stamp(used, photos.root), brackets=exposures, response=response)
    if step.result is None:
        moved = _merge(brackets, folder, response, open_bar("merging brackets", len(brackets)))
        step = step.complete({"moved": moved})
    by_path = {photo.path: photo for photo in photos.items}
    items = []
    for name, bracket in brackets.items():
        middle = by_path[sorted(bracket, key=lambda path, of=bracket: of[path])[len(bracket) // 2]]
        files = {"path": folder / IMAGES / f"{name}.exr", "valid": folder / VALID / f"{name}.png"}
        items.append(replace(middle, name=name, folder=".", exposure=None, **files))
    remark = f"{len(used)} photographs in {len(brackets)} exposure brackets were merged into "
    remark += f"{len(items)} linear images"
    if unused := len(photos.items) - len(set(used)):
        remark += f"; {unused} photographs in no bracket were left out"
    if shifts := [shift for shift in step.result["moved"].values() if shift]:
        remark += f"; those of {len(shifts)} brackets were aligned, by up to {max(shifts):.1f} pixels"
    return MergedPhotos(replace(photos, root=folder, items=tuple(items), linear=True), step, remark)


def _merge(
    brackets: Brackets, folder: Path, response: Literal["auto", "linear", "srgb"], bar: Bar
) -> dict[str, float]:
    """Merge the brackets that are not merged yet; return the largest shift of every bracket, in pixels."""
    path = folder / SHIFTS
    moved: dict[str, float] = {}
    if path.is_file():
        moved.update(Entry.load(path, "delete it: only the reported shifts are lost").entries())

    def done(name: str, shift: float | None) -> None:
        if shift is not None:
            moved[name] = shift
            write_json(path, moved)
        bar.advance()

    merge_brackets(brackets, folder / IMAGES, folder / VALID, response, done)
    return moved
