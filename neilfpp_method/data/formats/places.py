"""Find the files of a capture by the names that its description lists; shared by several readers."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path, PurePosixPath

from neilfpp_method.data.images import IMAGE_SUFFIXES
from neilfpp_method.data.paths import inside
from neilfpp_method.data.views import View
from neilfpp_method.errors import UserError

__all__ = ["check_masks", "stored", "stored_image", "view_names"]


def stored(root: Path, path: Path) -> Path | None:
    """Return the file, or the file of the same name with another image suffix; None if neither exists.

    A scene may list 000.png although the file is 000.exr or 000.PNG.

    Raises:
        UserError: the path leads out of `root`, or two files with other suffixes exist.
    """
    if inside(root, path).is_file():
        return path
    base = path.with_suffix("") if path.suffix.lower() in IMAGE_SUFFIXES else path
    candidates = [base.with_name(base.name + suffix) for suffix in IMAGE_SUFFIXES]
    existing = [inside(root, file) for file in candidates if file.is_file()] or _upper_case(root, base)
    if len(existing) > 1:
        names = " and ".join(file.name for file in existing)
        raise UserError(f"{path}: does not exist, and {names} are both possible", "keep one of them")
    return existing[0] if existing else None


def _upper_case(root: Path, base: Path) -> list[Path]:
    """The images with this name and a suffix of any case, such as IMG_7.JPG; found by listing the folder."""
    if not base.parent.is_dir():
        return []
    return [
        inside(root, file)
        for file in sorted(base.parent.iterdir())
        if file.stem == base.name and file.suffix.lower() in IMAGE_SUFFIXES
    ]


def stored_image(root: Path, path: Path, where: str) -> Path:
    """As `stored`, but a missing file is a `UserError`; `where` names the entry that lists it."""
    image = stored(root, path)
    if image is None:
        raise UserError(f"{where}: there is no {path}", "put the image there, or correct the path")
    return image


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
