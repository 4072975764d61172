"""Steps that are done once: each has a folder, and a marker of its inputs and its completion.

A marker is written in one step when the work is done. A step whose inputs have changed since starts from an
empty folder, one that was interrupted goes on with what its folder holds.
"""

from __future__ import annotations

import hashlib
import json
import os
import shutil
from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from neilfpp_method.data.images import replacing

__all__ = ["Step", "begin", "stamp"]

MARKER = "step.json"
VERSION = 2
"""Of what the steps leave in their folders; what another version left is done again."""


@dataclass(frozen=True)
class Step:
    """A step of the work. `result` is what it left when complete; none: it is to be done or continued."""

    folder: Path
    inputs: str
    result: dict[str, Any] | None

    def complete(self, result: dict[str, Any]) -> dict[str, Any]:
        """Mark the step as done; returns the result."""
        _mark(self.folder, self.inputs, result)
        return result


def begin(folder: Path, after: Step | None = None, **inputs: Any) -> Step:
    """Enter a step: done, begun, or to do.

    Args:
        folder: the step's own folder; emptied where it was made of other inputs.
        after: the step before, whose inputs are inputs of this one, too.
        inputs: all else that the step's outcome follows from, as JSON.
    """
    made_of = hashlib.sha256(
        json.dumps([VERSION, after and after.inputs, inputs], sort_keys=True).encode()
    ).hexdigest()
    marker = _marker(folder)
    if marker.get("inputs") != made_of:
        if folder.exists():
            shutil.rmtree(folder)
        _mark(folder, made_of, None)
        return Step(folder, made_of, None)
    return Step(folder, made_of, marker.get("result"))


def stamp(paths: Iterable[Path], root: Path) -> list[list[Any]]:
    """What tells whether files are still the same: names, sizes, and times of their last change."""
    stats = ((os.path.relpath(path, root), path.stat()) for path in paths)
    return [[name, stat.st_size, stat.st_mtime_ns] for name, stat in stats]


def _mark(folder: Path, inputs: str, result: dict[str, Any] | None) -> None:
    with replacing(folder / MARKER) as temporary:
        temporary.write_text(json.dumps({"inputs": inputs, "result": result}), "utf-8")


def _marker(folder: Path) -> dict[str, Any]:
    try:
        marker = json.loads((folder / MARKER).read_text("utf-8"))
    except (OSError, ValueError):
        return {}
    return marker if isinstance(marker, dict) else {}
