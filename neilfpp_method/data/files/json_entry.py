"""Read JSON files with errors that name the entry, and write them atomically."""

from __future__ import annotations

import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float64

from neilfpp_method.data.files.atomic_file import replacing
from neilfpp_method.errors import UserError

__all__ = ["Entry", "write_json"]

CAMERAS_REMEDY = "export the cameras again"
"""Remedy for a damaged file of cameras, which most of these files are."""


class Entry:
    """A value in a JSON file, and its place (`where`) for error messages.

    Args:
        value: the value.
        where: the file, and the keys that lead to the value.
        remedy: how to repair the file.
    """

    def __init__(self, value: Any, where: str, remedy: str = CAMERAS_REMEDY) -> None:
        self.value = value
        self.where = where
        self.remedy = remedy

    @staticmethod
    def load(path: Path, remedy: str = CAMERAS_REMEDY) -> Entry:
        """Read a file and return its root value; the remedy also applies to all entries of the file."""
        try:
            # Programs on Windows write a byte order mark at the beginning.
            return Entry(json.loads(path.read_text("utf-8-sig")), str(path), remedy)
        except (ValueError, OSError, RecursionError) as error:
            raise UserError(f"{path}: not valid JSON ({error})", remedy) from error

    def name(self, key: str) -> str:
        """Return the place of an entry of this object."""
        return f"{self.where}: {key}" if ": " not in self.where else f"{self.where}.{key}"

    def entries(self) -> Mapping[str, Any]:
        """Return the entries of a JSON object."""
        if not isinstance(self.value, dict):
            raise UserError(f"{self.where}: not a JSON object", self.remedy)
        return self.value

    def items(self) -> list[Entry]:
        """Return the elements of a JSON list."""
        if not isinstance(self.value, list):
            raise UserError(f"{self.where}: not a JSON list", self.remedy)
        return [Entry(value, self.name(str(i)), self.remedy) for i, value in enumerate(self.value)]

    def __getitem__(self, key: str) -> Entry:
        if key not in self.entries():
            raise UserError(f"{self.name(key)} is missing", self.remedy)
        return Entry(self.value[key], self.name(key), self.remedy)

    def get(self, key: str) -> Entry | None:
        """Return an entry; None if it is missing or null."""
        return None if self.entries().get(key) is None else self[key]

    def text(self) -> str:
        """Return a file name, with forward slashes."""
        name = self.value.replace("\\", "/") if isinstance(self.value, str) else ""
        if not Path(name).name:
            raise UserError(f"{self.where}: not a file name", "give a path relative to the capture")
        return name

    def word(self, *choices: str) -> str:
        """Return a string that is one of `choices`; any string if there are no choices."""
        if not isinstance(self.value, str) or (choices and self.value not in choices):
            raise UserError(f"{self.where}: not {' or '.join(choices) or 'a word'}", "correct the entry")
        return self.value

    def numbers(self, *shapes: tuple[int, ...]) -> Float64[np.ndarray, " *shape"]:
        """Return an array of finite numbers of one of the shapes; without shapes, of any length."""
        try:
            numbers = np.asarray(self.value, dtype=np.float64)
        except (TypeError, ValueError, OverflowError):
            numbers = np.full((), np.nan)
        fits = numbers.shape in shapes if shapes else numbers.ndim == 1
        if not fits or not np.isfinite(numbers).all():
            wanted = " or ".join(dict.fromkeys("×".join(map(str, shape)) for shape in shapes if shape))
            problem = (
                "not a finite number" if shapes == ((),) else f"not {wanted or 'a list of'} finite numbers"
            )
            raise UserError(f"{self.where}: {problem}", self.remedy)
        return numbers

    def number(self) -> float:
        """Return a finite number."""
        return float(self.numbers(()))

    def size(self) -> int:
        """Return a positive integer, which a file may also contain as a float."""
        number = self.number()
        if number < 1 or number != int(number):
            raise UserError(f"{self.where}: not a positive whole number", "give width and height in pixels")
        return int(number)


def write_json(path: Path, value: Mapping[str, Any]) -> None:
    """Write an object atomically.

    Raises:
        UserError: the file cannot be written.
        ValueError: a number is not finite, which JSON does not have.
    """
    with replacing(path) as temporary:
        temporary.write_text(json.dumps(value, indent=2, allow_nan=False) + "\n", "utf-8")
