"""Read the JSON objects of a run folder; `data.files.json_entry.write_json` writes them."""

from __future__ import annotations

import json
import sys
from pathlib import Path
from typing import Any, TypeVar

from neilfpp_method.errors import UserError
from neilfpp_method.settings.plain import from_dict

__all__ = ["is_finite_number", "read_entries", "read_json"]

Entry = TypeVar("Entry")


def read_json(path: Path) -> dict[str, Any]:
    """Read a JSON object.

    Raises:
        UserError: if the file is missing or malformed, or holds something other than an object.
    """
    try:
        value = json.loads(path.read_text())
    except (OSError, ValueError, RecursionError) as error:
        raise UserError(
            f"{path}: not readable as JSON ({error})", "restore the file or train again"
        ) from error
    if not isinstance(value, dict):
        raise UserError(f"{path}: not a JSON object", "restore the file or train again")
    return value


def read_entries(path: Path, version: int, key: str, kind: type[Entry]) -> list[Entry] | None:
    """Read a record whose `key` holds a list of entries.

    Args:
        path: the file.
        version: the value of its key `format`.
        key: name of the list.
        kind: dataclass of an entry.

    Returns:
        The entries; None if there is no file.

    Raises:
        UserError: if the file is damaged or of another version.
    """
    if not path.is_file():
        return None
    stored = read_json(path)
    if stored.get("format") != version or not isinstance(stored.get(key), list):
        raise UserError(
            f"{path}: a record of another version", "remove the file, or use the version that wrote it"
        )
    try:
        return [from_dict(kind, entry, str(path)) for entry in stored[key]]
    except (TypeError, AttributeError) as error:
        # A key is missing, or a value is not an object.
        raise UserError(
            f"{path}: not a complete record ({error})", "remove the file, or train again"
        ) from error


def is_finite_number(value: object) -> bool:
    """Whether a value from JSON is a number that a float can hold; an integer of JSON may have any length."""
    return isinstance(value, int | float) and abs(value) <= sys.float_info.max
