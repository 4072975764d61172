"""JSON in and out: values that know their place, so that errors can name it, and atomic writing."""

from __future__ import annotations

import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float64

from neilfpp_method.data.images import replacing
from neilfpp_method.errors import UserError

__all__ = ["Entry", "write_json"]


class Entry:
    """A value in a JSON file, and where it stands."""

    def __init__(self, value: Any, where: str) -> None:
        self.value = value
        self.where = where

    @staticmethod
    def load(path: Path) -> Entry:
        """The root of a file."""
        try:
            return Entry(
                json.loads(path.read_text("utf-8-sig")), str(path)
            )  # Windows puts a byte order mark first
        except (ValueError, OSError, RecursionError) as error:
            raise UserError(f"{path}: not valid JSON ({error})", "export the cameras again") from error

    def name(self, key: str) -> str:
        """The place of an entry below this one."""
        return f"{self.where}: {key}" if ": " not in self.where else f"{self.where}.{key}"

    def entries(self) -> Mapping[str, Any]:
        """The entries of an object."""
        if not isinstance(self.value, dict):
            raise UserError(f"{self.where}: not a JSON object", "export the cameras again")
        return self.value

    def items(self) -> list[Entry]:
        """The elements of a list."""
        if not isinstance(self.value, list):
            raise UserError(f"{self.where}: not a JSON list", "export the cameras again")
        return [Entry(value, self.name(str(i))) for i, value in enumerate(self.value)]

    def __getitem__(self, key: str) -> Entry:
        if key not in self.entries():
            raise UserError(f"{self.name(key)} is missing", "export the cameras again")
        return Entry(self.value[key], self.name(key))

    def get(self, key: str) -> Entry | None:
        """An entry that may be missing or null."""
        return None if self.entries().get(key) is None else self[key]

    def text(self) -> str:
        """A file name; Windows's separators become the usual ones."""
        name = self.value.replace("\\", "/") if isinstance(self.value, str) else ""
        if not Path(name).name:
            raise UserError(f"{self.where}: not a file name", "give a path relative to the capture")
        return name

    def word(self, *choices: str) -> str:
        """One of the words; any, where none are given."""
        if not isinstance(self.value, str) or (choices and self.value not in choices):
            raise UserError(f"{self.where}: not {' or '.join(choices) or 'a word'}", "correct the entry")
        return self.value

    def numbers(self, *shapes: tuple[int, ...]) -> Float64[np.ndarray, " *shape"]:
        """An array of finite numbers, of one of the shapes; without shapes, a list of any length."""
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
            raise UserError(f"{self.where}: {problem}", "export the cameras again")
        return numbers

    def number(self) -> float:
        """One finite number."""
        return float(self.numbers(()))

    def size(self) -> int:
        """A positive whole number; files write sizes as floats, too."""
        number = self.number()
        if number < 1 or number != int(number):
            raise UserError(f"{self.where}: not a positive whole number", "give width and height in pixels")
        return int(number)


def write_json(path: Path, value: Mapping[str, Any]) -> None:
    """Write an object atomically; numbers that are not finite do not exist in JSON: a `ValueError`."""
    with replacing(path) as temporary:
        temporary.write_text(json.dumps(value, indent=1, allow_nan=False) + "\n", "utf-8")
