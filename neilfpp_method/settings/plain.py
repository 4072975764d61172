"""Settings to and from plain JSON values, with every value checked on the way in."""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping
from typing import Any, TypeVar, get_args, get_type_hints

from neilfpp_method.errors import UserError

__all__ = ["from_dict", "to_dict"]


def to_dict(config: Any) -> dict[str, Any]:
    """The settings as plain JSON values."""
    return dataclasses.asdict(config)


Config = TypeVar("Config")


def from_dict(kind: type[Config], values: Mapping[str, Any], where: str = "config") -> Config:
    """Settings from JSON values, the inverse of `to_dict`.

    Raises:
        UserError: a key is unknown or a value has the wrong type; names the setting.
    """
    hints = get_type_hints(kind)
    unknown = set(values) - set(hints)
    if unknown:
        raise UserError(f"{where}: unknown setting '{sorted(unknown)[0]}'", "was it written by another version?")
    arguments = {}
    for name, value in values.items():
        if dataclasses.is_dataclass(hints[name]):
            value = from_dict(hints[name], value, f"{where}.{name}")
        elif isinstance(value, list):
            value = tuple(value)
        else:
            _check(value, hints[name], f"{where}.{name}")
        arguments[name] = value
    return kind(**arguments)


def _check(value: Any, hint: Any, where: str) -> None:
    """That a JSON value is one of the choices, or of one of the plain types, that a hint names."""
    choices = get_args(hint)
    if choices and all(isinstance(choice, str) for choice in choices):
        if value not in choices:
            raise UserError(f"{where}: '{value}' is not a choice", f"choose one of {', '.join(choices)}")
        return
    plain = [kind for kind in choices or (hint,) if isinstance(kind, type)]
    # JSON has one kind of number, and bool is an int to Python but to nobody else.
    fits = any(isinstance(value, (int, float) if kind is float else kind) for kind in plain)
    if plain and (not fits or (isinstance(value, bool) and bool not in plain)):
        names = " or ".join("nothing" if kind is type(None) else kind.__name__ for kind in plain)
        raise UserError(f"{where}: {value!r} where {names} belongs", "correct the file, or train again")
