"""Settings to and from plain values (JSON, YAML), and changes to them; every value is checked."""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping
from difflib import get_close_matches
from typing import Any, TypeVar, get_args, get_type_hints

from neilfpp_method.errors import UserError

__all__ = ["changed", "from_dict", "to_dict"]

Config = TypeVar("Config")


def to_dict(config: Any) -> dict[str, Any]:
    """The settings as plain values."""
    return dataclasses.asdict(config)


def from_dict(kind: type[Config], values: Mapping[str, Any], where: str = "config") -> Config:
    """Settings from plain values, the inverse of `to_dict`.

    Raises:
        UserError: a key is unknown or a value has the wrong type; names the setting.
    """
    hints = get_type_hints(kind)
    for name in values:
        _check_known(name, hints, where)
    arguments = {}
    for name, value in values.items():
        room = _room(hints[name], value, f"{where}.{name}")
        arguments[name] = (
            from_dict(room, value, f"{where}.{name}")
            if room
            else _leaf(value, hints[name], f"{where}.{name}")
        )
    return kind(**arguments)


def changed(config: Config, values: Mapping[str, Any], where: str = "config") -> Config:
    """The same settings but for these.

    A part (light, host, encoding) whose `kind` changes starts from the defaults of its new kind.

    Args:
        config: a dataclass of settings.
        values: by name; a room is a mapping of its own, or its settings are named with dots. Dashes count as
            underscores.
        where: what the settings are called in a complaint.

    Raises:
        UserError: a key is unknown or a value has the wrong type; names the setting.

    Example:
        >>> changed(NeilfConfig(), {"train.rays": 512, "light": {"kind": "distant"}}).train.rays
        512
    """
    hints = get_type_hints(type(config))
    arguments = {}
    for name, value in _by_room(values, where).items():
        _check_known(name, hints, where)
        inside = f"{where}.{name}"
        room = _room(hints[name], value, inside, now=getattr(config, name))
        if room:
            now = getattr(config, name)
            value = changed(now if type(now) is room else room(), value, inside)
        arguments[name] = value if room else _leaf(value, hints[name], inside)
    return dataclasses.replace(config, **arguments)


def _by_room(values: Any, where: str) -> dict[str, Any]:
    """Dotted names taken apart, and what belongs to one room put together."""
    if not isinstance(values, Mapping):
        raise UserError(f"{where}: {values!r} where settings belong", "give it as names and values")
    rooms: dict[str, Any] = {}
    for key, value in values.items():
        name, dot, rest = str(key).replace("-", "_").partition(".")
        before = rooms.get(name, {} if dot or isinstance(value, Mapping) else None)
        if dot:
            value = {rest: value}
        if isinstance(before, Mapping) and isinstance(value, Mapping):
            value = {**before, **value}
        elif name in rooms:
            raise UserError(f"{where}.{name} is set twice", "set it once")
        rooms[name] = value
    return rooms


def _check_known(name: str, hints: Mapping[str, Any], where: str) -> None:
    if name not in hints:
        near = get_close_matches(name, hints, n=1)
        remedy = f"did you mean '{near[0]}'?" if near else f"it has {', '.join(sorted(hints))}"
        raise UserError(f"{where}: unknown setting '{name}'", remedy)


def _room(hint: Any, value: Any, where: str, now: Any = None) -> type | None:
    """The dataclass that a mapping of settings stands for: where there are several, that of its `kind`; none:
    a value.
    """
    rooms = [kind for kind in (hint, *get_args(hint)) if dataclasses.is_dataclass(kind)]
    if not rooms:
        return None
    if not isinstance(value, Mapping):
        raise UserError(f"{where}: {value!r} where settings belong", "give it as names and values")
    if len(rooms) == 1:
        return rooms[0]
    if "kind" not in value:
        return type(now) if now is not None else rooms[0]
    kinds = {kind: room for room in rooms for kind in get_args(get_type_hints(room)["kind"])}
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
    """That a list is of a tuple's length, and of its types."""
    wanted = next(
        (get_args(kind) for kind in (hint, *get_args(hint)) if getattr(kind, "__origin__", None) is tuple),
        None,
    )
    if wanted is None:
        raise UserError(f"{where}: a list where one value belongs", "give one value")
    if len(wanted) == 2 and wanted[1] is Ellipsis:
        wanted = (wanted[0],) * len(values)
    if len(values) != len(wanted):
        raise UserError(f"{where}: {len(values)} numbers where {len(wanted)} belong", "give as many")
    for value, kind in zip(values, wanted, strict=True):
        _check(value, kind, where)
    return values


def _check(value: Any, hint: Any, where: str) -> None:
    """That a plain value is one of the choices, or of one of the plain types, that a hint names."""
    choices = get_args(hint)
    if choices and all(isinstance(choice, str) for choice in choices):
        if value not in choices:
            raise UserError(f"{where}: '{value}' is not a choice", f"choose one of {', '.join(choices)}")
        return
    plain = [kind for kind in choices or (hint,) if isinstance(kind, type)]
    # Files have one kind of number, and bool is an int to Python but to nobody else.
    fits = any(isinstance(value, (int, float) if kind is float else kind) for kind in plain)
    if plain and (not fits or (isinstance(value, bool) and bool not in plain)):
        names = " or ".join("nothing" if kind is type(None) else kind.__name__ for kind in plain)
        raise UserError(f"{where}: {value!r} where {names} belongs", "correct the file, or train again")
