"""Convert settings to and from plain values (JSON, YAML), and change some of them; every value is checked."""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping
from difflib import get_close_matches
from typing import Any, TypeVar, get_args, get_type_hints

from neilfpp_method.errors import UserError

__all__ = ["changed", "from_dict", "to_dict"]

Config = TypeVar("Config")


def to_dict(config: Any) -> dict[str, Any]:
    """Convert settings to nested dictionaries of plain values."""
    return dataclasses.asdict(config)


def from_dict(kind: type[Config], values: Mapping[str, Any], where: str = "config") -> Config:
    """Make settings from plain values, the inverse of `to_dict`. Absent settings get their defaults.

    Args:
        kind: the dataclass of settings.
        values: nested mappings of plain values.
        where: name of the settings in error messages.

    Raises:
        UserError: a setting is unknown or its value has the wrong type; the message names the setting.
    """
    hints = get_type_hints(kind)
    for name in values:
        _check_known(name, hints, where)
    arguments = {}
    for name, value in values.items():
        inside = f"{where}.{name}"
        part = _part(hints[name], value, inside)
        arguments[name] = from_dict(part, value, inside) if part else _leaf(value, hints[name], inside)
    return kind(**arguments)


def changed(config: Config, values: Mapping[str, Any], where: str = "config") -> Config:
    """Return settings with some values changed.

    A part (light, host, encoding) whose `kind` changes gets the defaults of its new kind.

    Args:
        config: a dataclass of settings.
        values: new values by name. The settings of a part are a nested mapping, or have dotted names. Dashes
            in names count as underscores.
        where: name of the settings in error messages.

    Raises:
        UserError: a setting is unknown or its value has the wrong type; the message names the setting.

    Example:
        >>> changed(NeilfConfig(), {"train.rays": 512, "light": {"kind": "distant"}}).train.rays
        512
    """
    hints = get_type_hints(type(config))
    arguments = {}
    for name, value in _by_part(values, where).items():
        _check_known(name, hints, where)
        inside, current = f"{where}.{name}", getattr(config, name)
        part = _part(hints[name], value, inside, current)
        if part:
            arguments[name] = changed(current if type(current) is part else part(), value, inside)
        else:
            arguments[name] = _leaf(value, hints[name], inside)
    return dataclasses.replace(config, **arguments)


def _by_part(values: Any, where: str) -> dict[str, Any]:
    """Split dotted names, and merge the settings of each part into one mapping."""
    if not isinstance(values, Mapping):
        raise UserError(f"{where}: {values!r} where settings belong", "give names and values")
    parts: dict[str, Any] = {}
    for key, value in values.items():
        name, dot, rest = str(key).replace("-", "_").partition(".")
        before = parts.get(name, {} if dot or isinstance(value, Mapping) else None)
        if dot:
            value = {rest: value}
        if isinstance(before, Mapping) and isinstance(value, Mapping):
            value = {**before, **value}
        elif name in parts:
            raise UserError(f"{where}.{name} is set twice", "set it once")
        parts[name] = value
    return parts


def _check_known(name: str, hints: Mapping[str, Any], where: str) -> None:
    if name not in hints:
        near = get_close_matches(name, hints, n=1)
        remedy = f"did you mean '{near[0]}'?" if near else f"its settings are {', '.join(sorted(hints))}"
        raise UserError(f"{where}: unknown setting '{name}'", remedy)


def _part(hint: Any, value: Any, where: str, current: Any = None) -> type | None:
    """The dataclass of a mapping of settings, or None if the hint is that of a single value.

    Of several dataclasses it is the one of the mapping's `kind`, else that of the current settings.
    """
    parts = [kind for kind in (hint, *get_args(hint)) if dataclasses.is_dataclass(kind)]
    if not parts:
        return None
    if not isinstance(value, Mapping):
        raise UserError(f"{where}: {value!r} where settings belong", "give names and values")
    if len(parts) == 1:
        return parts[0]
    if "kind" not in value:
        return type(current) if current is not None else parts[0]
    kinds = {kind: part for part in parts for kind in get_args(get_type_hints(part)["kind"])}
    if not isinstance(value["kind"], str) or value["kind"] not in kinds:
        raise UserError(
            f"{where}.kind: '{value['kind']}' is not a choice", f"choose one of {', '.join(kinds)}"
        )
    return kinds[value["kind"]]


def _leaf(value: Any, hint: Any, where: str) -> Any:
    if isinstance(value, list | tuple):
        return tuple(_check_items(value, hint, where))
    _check(value, hint, where)
    return value


def _check_items(values: list | tuple, hint: Any, where: str) -> list | tuple:
    """Check that a list has the length and the types of the tuple in the hint."""
    wanted = next(
        (get_args(kind) for kind in (hint, *get_args(hint)) if getattr(kind, "__origin__", None) is tuple),
        None,
    )
    if wanted is None:
        raise UserError(f"{where}: a list where one value belongs", "give one value")
    if len(wanted) == 2 and wanted[1] is Ellipsis:
        wanted = (wanted[0],) * len(values)
    if len(values) != len(wanted):
        raise UserError(f"{where}: {len(values)} numbers where {len(wanted)} belong", f"give {len(wanted)}")
    for value, kind in zip(values, wanted, strict=True):
        _check(value, kind, where)
    return values


def _check(value: Any, hint: Any, where: str) -> None:
    """Check that a plain value is one of the choices, or has one of the plain types, of a hint."""
    choices = get_args(hint)
    if choices and all(isinstance(choice, str) for choice in choices):
        if value not in choices:
            raise UserError(f"{where}: '{value}' is not a choice", f"choose one of {', '.join(choices)}")
        return
    plain = [kind for kind in choices or (hint,) if isinstance(kind, type)]
    # Files do not distinguish int from float. In Python bool is a subclass of int, which is not meant here.
    fits = any(isinstance(value, (int, float) if kind is float else kind) for kind in plain)
    if plain and (not fits or (isinstance(value, bool) and bool not in plain)):
        names = " or ".join("null" if kind is type(None) else kind.__name__ for kind in plain)
        raise UserError(f"{where}: {value!r} where {names} belongs", "correct the value")
