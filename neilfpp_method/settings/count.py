"""List the names of all settings."""

from __future__ import annotations

import dataclasses
from collections.abc import Iterator
from typing import get_args, get_type_hints

__all__ = ["leaves"]


def leaves(kind: type, where: str = "") -> Iterator[str]:
    """Yield the dotted name of every setting once; for a part with several kinds, those of all its kinds.

    Args:
        kind: a dataclass of settings.
        where: prefix of the names.

    Example:
        >>> sorted(set(leaves(NeilfConfig)))[0]
        'background.color'
    """
    for name, hint in get_type_hints(kind).items():
        parts = [part for part in (hint, *get_args(hint)) if dataclasses.is_dataclass(part)]
        if parts:
            # A dictionary removes duplicates and keeps the order.
            yield from {leaf: None for part in parts for leaf in leaves(part, f"{where}{name}.")}
        else:
            yield f"{where}{name}"
