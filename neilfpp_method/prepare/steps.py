"""Steps of a long command that are done once and can be interrupted.

Each step has a folder with a marker file, which holds a hash of the step's inputs and, when the step is
complete, its result. A step whose inputs have changed starts again with an empty folder; an interrupted step
continues with the files in its folder. Markers are replaced atomically.
"""

from __future__ import annotations

import hashlib
import json
import os
import shutil
from collections.abc import Iterable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from neilfpp_method.data.files.atomic_file import replacing

__all__ = ["Step", "begin", "stamp"]

MARKER = "step.json"
"""Name of the marker file."""

VERSION = 2
"""Version of the files that steps write. A step that another version has written is done again."""


@dataclass(frozen=True)
class Step:
    """A step of the work.

    Attributes:
        folder: folder of its files.
        inputs: hash of its inputs and of those of all steps before it.
        result: JSON result of the complete step; None if it must be done or continued.
    """

    folder: Path
    inputs: str
    result: dict[str, Any] | None

    def complete(self, result: dict[str, Any]) -> Step:
        """Mark the step as complete; return it with its result."""
        _mark(self.folder, self.inputs, result)
        return replace(self, result=result)


def begin(folder: Path, after: Step | None = None, **inputs: Any) -> Step:
    """Enter a step and report whether it is complete already.

    Args:
        folder: folder of the step; it is emptied if it was written for other inputs.
        after: the previous step, whose inputs are inputs of this one as well.
        inputs: all other values on which the result depends, as JSON values.
    """
    digest = hashlib.sha256(
        json.dumps([VERSION, after and after.inputs, inputs], sort_keys=True).encode()
    ).hexdigest()
    marker = _marker(folder)
    if marker.get("inputs") != digest:
        if folder.exists():
            # The marker goes first: a folder that is half emptied must not count as the other inputs' result.
            (folder / MARKER).unlink(missing_ok=True)
            shutil.rmtree(folder)
        _mark(folder, digest, None)
        return Step(folder, digest, None)
    return Step(folder, digest, marker.get("result"))


def stamp(paths: Iterable[Path], root: Path) -> list[list[Any]]:
    """Return names, sizes and modification times of files, by which changed files are detected."""
    stats = ((os.path.relpath(path, root), path.stat()) for path in paths)
    return [[name, stat.st_size, stat.st_mtime_ns] for name, stat in stats]


def _mark(folder: Path, inputs: str, result: dict[str, Any] | None) -> None:
    with replacing(folder / MARKER) as temporary:
        temporary.write_text(json.dumps({"inputs": inputs, "result": result}), "utf-8")


def _marker(folder: Path) -> dict[str, Any]:
    try:
        marker = json.loads((folder / MARKER).read_text("utf-8"))
    except (OSError, ValueError, RecursionError):
        return {}
    return marker if isinstance(marker, dict) else {}
