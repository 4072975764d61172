"""Checks of paths and names that come from a capture."""

from __future__ import annotations

import os
from pathlib import Path

from neilfpp_method.errors import UserError

__all__ = ["inside", "plain_name"]


def inside(root: Path, path: Path) -> Path:
    """Return `path` if it is inside of `root` after links have been resolved.

    Without this check, a capture from an untrusted source could make the program read any file.

    Raises:
        UserError: the path leaves `root`, or is not a valid path.
    """
    try:
        # `exists` raises an exception for an impossible name.
        path.exists()
        if path.resolve().is_relative_to(root.resolve()):
            return path
        if path.exists() and Path(os.path.abspath(path)).is_relative_to(os.path.abspath(root)):
            link = next(p for p in (path, *path.parents) if p.is_symlink())
            problem = f"{path}: not a path within the capture folder {root}, because {link.name} is a link"
            raise UserError(problem, "replace the link by a copy of its files, as cp -rL makes it")
    except (OSError, RuntimeError, ValueError):
        # The name is too long, links form a loop, or the name contains a null byte.
        pass
    raise UserError(f"{path}: not a path within the capture folder {root}", "copy the file into the folder")


def plain_name(name: str) -> bool:
    """Return whether a name is a valid file name on all systems: without folders, not hidden, printable."""
    return bool(name) and name.isprintable() and not name.startswith(".") and not set(name) & set("/\\:")
