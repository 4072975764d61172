"""How many settings there are."""

from __future__ import annotations

import dataclasses
from collections.abc import Iterator
from typing import get_args, get_type_hints

__all__ = ["leaves"]


def leaves(kind: type, where: str = "") -> Iterator[str]:
    """The dotted name of every setting, once; of a room with several kinds those of all kinds.

    Example:
        >>> sorted(set(leaves(NeilfConfig)))[0]
        'background.color'
    """
    for name, hint in get_type_hints(kind).items():
        rooms = [room for room in (hint, *get_args(hint)) if dataclasses.is_dataclass(room)]
        if rooms:
            yield from {leaf: None for room in rooms for leaf in leaves(room, f"{where}{name}.")}
        else:
            yield f"{where}{name}"
