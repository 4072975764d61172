"""Write a file so that readers never see a part of it."""

from __future__ import annotations

import os
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

from neilfpp_method.errors import UserError

__all__ = ["replacing"]


@contextmanager
def replacing(path: Path) -> Iterator[Path]:
    """Provide a temporary path, which replaces `path` at the end of the block; it is removed if that fails.

    Readers never see a partial file, even if the process is killed. Missing folders are created.

    Raises:
        UserError: the operating system refuses to write the file; an existing file is kept.

    Example:
        >>> with replacing(Path("figures.json")) as temporary:
        ...     temporary.write_text("{}")
    """
    temporary = path.parent / f".{path.stem}.{os.getpid()}{path.suffix}"
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        yield temporary
        os.replace(temporary, path)
    except OSError as error:
        remedy = "make room there, or choose a folder that can be written"
        raise UserError(f"{path}: cannot be written ({error.strerror or error})", remedy) from error
    finally:
        with suppress(OSError):
            temporary.unlink(missing_ok=True)
