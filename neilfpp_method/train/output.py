"""Output paths of commands: the default folder of a run, and checks that run before any computation."""

from __future__ import annotations

import os
from pathlib import Path

from neilfpp_method.errors import UserError
from neilfpp_method.settings.types import NeilfConfig

__all__ = ["check_folder", "check_page", "check_writable", "default_folder"]

PAGE_SUFFIXES = (".html", ".htm")
"""Suffixes that the name of a page may have."""
RECORDS = ("capture.json", "config.json", "effects.json", "environment.json", "scene.json", "split.json")
"""Names of files that describe a run or a capture, which a result must not replace."""


def default_folder(data: Path, config: NeilfConfig) -> Path:
    """The folder of a new run without --out: runs/CAPTURE-PRESET."""
    return Path("runs") / f"{data.resolve().name}-{config.preset}"


def check_writable(path: Path) -> None:
    """Check that a file can be written. Its folder need not exist.

    Raises:
        UserError: the path is a folder or a file that describes a run, or a folder above it cannot be written
            to.
    """
    if path.is_dir():
        raise UserError(f"{path}: is a folder", "name a file with --out")
    if path.name in RECORDS and path.exists():
        raise UserError(
            f"{path}: describes a run or a capture, and would be replaced", "choose another --out"
        )
    _check_above(path, path)


def check_page(path: Path) -> None:
    """The same as `check_writable` for a page, whose name must say that it is one.

    Raises:
        UserError: as `check_writable`, or the name has another suffix.
    """
    check_writable(path)
    if path.suffix.lower() not in PAGE_SUFFIXES:
        raise UserError(f"{path}: a report is an HTML page", "give --out a name that ends in .html")


def check_folder(path: Path) -> None:
    """Check that files can be written into a folder. It need not exist.

    Raises:
        UserError: the path is a file, or a folder above it cannot be written to.
    """
    if path.exists() and not path.is_dir():
        raise UserError(f"{path}: is a file", "name a folder with --out")
    _check_above(path / "file", path)


def _check_above(path: Path, named: Path) -> None:
    above = next(folder for folder in path.absolute().parents if folder.exists())
    if not above.is_dir() or not os.access(above, os.W_OK):
        raise UserError(
            f"{named}: cannot be written, because {above} is not a writable folder", "choose another --out"
        )
