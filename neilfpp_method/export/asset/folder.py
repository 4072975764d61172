"""A folder that appears when all of its files are there."""

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
    """A temporary folder beside `path`; when the block ends its files move into `path`; always removed.

    Moving takes no room, so a full disk shows before anything is there. What else `path` holds stays.

    Raises:
        UserError: the system does not let it be written.
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
        remedy = "make room there, or choose a folder that can be written"
        raise UserError(f"{path}: cannot be written ({error.strerror or error})", remedy) from error
    finally:
        shutil.rmtree(temporary, ignore_errors=True)
