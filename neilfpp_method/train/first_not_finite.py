"""Which operation is the first whose result is not finite, and comes to bear on a loss or a gradient.

Infinities that a mask takes out again are harmless and common. So every value that is not finite is
followed from the operation that made it out of finite values, and only what arrives at the end is told.
"""

from __future__ import annotations

import traceback
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import torch
from torch import Tensor
from torch.utils._python_dispatch import TorchDispatchMode
from torch.utils._pytree import tree_leaves

__all__ = ["Origin", "OriginsOfNotFinite", "is_finite"]

PACKAGE = Path(__file__).parents[1]
UNINITIALISED = ("empty", "new_empty", "resize")
"""Operations whose results hold whatever the memory held before."""


@dataclass(frozen=True)
class Origin:
    """An operation that made values that are not finite out of finite ones.

    Attributes:
        order: how many such operations came before it.
        operation: torch's name of it, such as `aten.div.Tensor`.
        derivative_of: the operation whose derivative it computes, such as `DivBackward0`; none: it is part of
            the forward pass.
        place: file, line and function of this package that asked for it, of the forward operation where it is
            a derivative; none: no code of this package did.
        code: that line.
        broken: how many of its values are not finite.
        values: how many values it has.
        rows: along its first axis, those with such a value.
        length: of its first axis.
    """

    order: int
    operation: str
    derivative_of: str | None
    place: str | None
    code: str
    broken: int
    values: int
    rows: tuple[int, ...]
    length: int


class OriginsOfNotFinite(TorchDispatchMode):
    """A context in which every operation of torch is looked at; `origin_of` tells where a value came from.

    Example:
        >>> with OriginsOfNotFinite() as origins:
        ...     x = torch.zeros(2)
        ...     y = (x / x) + 1.0
        >>> origins.origin_of(y).operation
        'aten.div.Tensor'
    """

    def __init__(self) -> None:
        super().__init__()
        self._origins: dict[int, Origin] = {}
        self._count = 0

    def origin_of(self, value: Tensor) -> Origin | None:
        """The operation that a value's NaN or infinity comes from; none: the value is finite, or no operation
        of the context made it.
        """
        return None if is_finite(value) else self._origins.get(_memory(value))

    def __torch_dispatch__(self, func: Any, types: Any, args: Any = (), kwargs: Any = None) -> Any:
        broken = [_memory(value) for value in _tensors((args, kwargs)) if not is_finite(value)]
        known = [self._origins[memory] for memory in broken if memory in self._origins]
        result = func(*args, **(kwargs or {}))
        fresh = func.__name__.startswith(UNINITIALISED)
        for value in _tensors(result):
            if fresh:
                self._origins.pop(_memory(value), None)
            elif is_finite(value):
                continue
            elif known:
                self._origins[_memory(value)] = min(known, key=lambda origin: origin.order)
            elif not broken:  # else it came in as it is: from outside, or out of a compiled loop
                self._origins[_memory(value)] = _origin(self._count, func, value)
                self._count += 1
        return result


def is_finite(value: Tensor) -> bool:
    """Whether all of a tensor is; integers always are."""
    return not value.dtype.is_floating_point or bool(torch.isfinite(value).all())


def _tensors(nest: Any) -> Iterator[Tensor]:
    return (leaf for leaf in tree_leaves(nest) if isinstance(leaf, Tensor))


def _memory(value: Tensor) -> int:
    """Views, and what is written in place, share the memory of what they were."""
    return value.untyped_storage().data_ptr()


def _origin(order: int, func: Any, value: Tensor) -> Origin:
    flat = value.detach().reshape(len(value) if value.ndim else 1, -1)
    wrong = ~torch.isfinite(flat)
    rows = tuple(torch.nonzero(wrong.any(1))[:, 0].tolist())
    node = torch._C._current_autograd_node()
    place, code = _place_of_forward(node) if node is not None else _place_here()
    derivative = None if node is None else node.name()
    return Origin(order, str(func), derivative, place, code, int(wrong.sum()), flat.numel(), rows, len(flat))


def _place_here() -> tuple[str | None, str]:
    for frame in reversed(traceback.extract_stack()):
        path = Path(frame.filename)
        if path.is_relative_to(PACKAGE) and path != Path(__file__):
            return f"{path.relative_to(PACKAGE)}:{frame.lineno} ({frame.name})", frame.line or ""
    return None, ""


def _place_of_forward(node: Any) -> tuple[str | None, str]:
    """From what torch's anomaly mode noted when the operation was computed: lines `File "…", line 3, in
    f`.
    """
    for entry in reversed(node.metadata.get("traceback_", [])):
        head, _, code = entry.strip().partition("\n")
        name, _, rest = head.removeprefix('File "').partition('", line ')
        number, _, function = rest.partition(", in ")
        if Path(name).is_relative_to(PACKAGE) and Path(name) != Path(__file__):
            return f"{Path(name).relative_to(PACKAGE)}:{number} ({function})", code.strip()
    return None, ""
