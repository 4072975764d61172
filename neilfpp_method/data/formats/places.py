"""Find the files of a capture by the names that its description lists; shared by several readers."""

from __future__ import annotations

from collections.abc import Collection, Sequence
from pathlib import Path, PurePosixPath

from neilfpp_method.data.files.images import IMAGE_SUFFIXES, UNREAD_SUFFIXES
from neilfpp_method.data.files.paths import inside
from neilfpp_method.data.views import View
from neilfpp_method.errors import UserError

__all__ = ["check_masks", "stored", "stored_image", "stored_images", "view_names"]

MAX_MISSING = 0.5
"""Largest share of the listed images that may be missing. If more are, the folder is more likely wrong."""


def stored(root: Path, path: Path) -> Path | None:
    """Return the file, or the file of the same name with another image suffix; None if neither exists.

    A scene may list 000.png although the file is 000.exr or 000.PNG.

    Raises:
        UserError: the path leads out of `root`, or two files with other suffixes exist.
    """
    if inside(root, path).is_file():
        return path
    base = _without_suffix(path)
    candidates = [base.with_name(base.name + suffix) for suffix in IMAGE_SUFFIXES]
    existing = [inside(root, file) for file in candidates if file.is_file()] or _upper_case(root, base)
    if len(existing) > 1:
        names = " and ".join(file.name for file in existing)
        raise UserError(f"{path}: does not exist, and {names} are both possible", "keep one of them")
    return existing[0] if existing else None


def _without_suffix(path: Path) -> Path:
    return path.with_suffix("") if path.suffix.lower() in IMAGE_SUFFIXES else path


def _upper_case(root: Path, base: Path) -> list[Path]:
    """The images with this name and a suffix of any case, such as IMG_7.JPG; found by listing the folder."""
    return [inside(root, file) for file in _named(base, IMAGE_SUFFIXES)]


def _named(base: Path, suffixes: Collection[str]) -> list[Path]:
    """The files with this name and one of the suffixes, in any case."""
    if not base.parent.is_dir():
        return []
    files = sorted(base.parent.iterdir())
    return [file for file in files if file.stem == base.name and file.suffix.lower() in suffixes]


def stored_image(root: Path, path: Path, where: str) -> Path:
    """As `stored`, but a missing file is a `UserError`; `where` names the entry that lists it."""
    image = stored(root, path)
    if image is None:
        raise _no_image(path, where)
    return image


def stored_images(root: Path, paths: Sequence[Path], where: str) -> tuple[Path | None, ...]:
    """As `stored` for all images that `where` lists.

    Up to `MAX_MISSING` of them may be missing: cameras are often written before images are deleted. Callers
    leave out their views and report them in `CaptureFiles.missing`.

    Raises:
        UserError: more are missing, or one is there in a format that is not read.
    """
    images = tuple(stored(root, path) for path in paths)
    missing = [path for path, image in zip(paths, images, strict=True) if image is None]
    unread = next((path for path in missing if _unread(path)), None)
    if unread or len(missing) > MAX_MISSING * len(paths):
        counted = f" ({len(missing)} of {len(paths)} images are missing)" if len(missing) > 1 else ""
        raise _no_image(unread or missing[0], where, counted)
    return images


def _no_image(path: Path, where: str, counted: str = "") -> UserError:
    problem = f"{where}: there is no {path}"
    remedy = "put the image there, correct the path, or remove the entry"
    for unread in _unread(path):
        problem += f", only {unread.name}, whose format is not read"
        remedy = "convert it to PNG or JPEG"
    return UserError(problem + counted, remedy)


def _unread(path: Path) -> list[Path]:
    """The files with the name of the image in formats that are not read."""
    return _named(_without_suffix(path), UNREAD_SUFFIXES)


def check_masks(folder: Path, views: Sequence[View]) -> None:
    """Check that a folder of masks holds the mask of at least one view.

    Raises:
        UserError: it holds images, but none is named after a view, so that all of them would be ignored.
    """
    if any(view.mask for view in views) or not folder.is_dir():
        return
    images = sorted(path.name for path in folder.rglob("*") if path.suffix.lower() in IMAGE_SUFFIXES)
    if images:
        raise UserError(
            f"{folder}: no mask is named after an image; the first is {images[0]}",
            f"name the mask of {views[0].image.name} {views[0].image.stem}.png, or remove the folder",
        )


def view_names(listed: Sequence[str]) -> tuple[str, ...]:
    """Return unique names for views: the stems of the listed files.

    If two stems are equal, all names contain their folders as well: "left-000".
    """
    paths = [PurePosixPath(name.replace("\\", "/")) for name in listed]
    stems = tuple(path.stem for path in paths)
    return stems if len(set(stems)) == len(stems) else tuple(_with_folders(path) for path in paths)


def _with_folders(path: PurePosixPath) -> str:
    folders = [part for part in path.parts[:-1] if part not in ("/", ".", "..", "images")]
    return "-".join([*folders, path.stem])
