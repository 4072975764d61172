"""Output paths of commands: the default folder of a run, and checks that run before any computation."""

from __future__ import annotations

import os
from pathlib import Path

from neilfpp_method.errors import UserError
from neilfpp_method.settings.types import NeilfConfig

__all__ = ["check_folder", "check_writable", "default_folder"]


def default_folder(data: Path, config: NeilfConfig) -> Path:
    """The folder of a new run without --out: runs/CAPTURE-PRESET."""
    return Path("runs") / f"{data.resolve().name}-{config.preset}"


def check_writable(path: Path) -> None:
    """Check that a file can be written. Its folder need not exist.

    Raises:
        UserError: the path is a folder, or a folder above it cannot be written to.
    """
    if path.is_dir():
        raise UserError(f"{path}: is a folder", "name a file with --out")
    _check_above(path, path)


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
