"""Write several files into a folder atomically."""

from __future__ import annotations

import os
import shutil
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from neilfpp_method.errors import UserError

__all__ = ["filling"]


@contextmanager
def filling(path: Path) -> Iterator[Path]:
    """Yield a temporary folder beside `path`, and move its files into `path` when the block succeeds.

    The temporary folder is always removed. Moving needs no disk space, so a full disk is noticed before any
    file of `path` changes. Other files in `path` are kept.

    Raises:
        UserError: a file cannot be written.
    """
    temporary = path.parent / f".{path.name}.{os.getpid()}"
    try:
        temporary.mkdir(parents=True)
        yield temporary
        for file in sorted(file for file in temporary.rglob("*") if file.is_file()):
            target = path / file.relative_to(temporary)
            target.parent.mkdir(parents=True, exist_ok=True)
            os.replace(file, target)
    except OSError as error:
        remedy = "free disk space there, or choose a folder that can be written"
        raise UserError(f"{path}: cannot be written ({error.strerror or error})", remedy) from error
    finally:
        shutil.rmtree(temporary, ignore_errors=True)
