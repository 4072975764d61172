"""Find the first operation whose non-finite result reaches a loss or a gradient.

A NaN or infinity that a mask removes later is harmless and common. So every non-finite value is traced from
the operation that produced it out of finite values, and only origins that reach a loss or gradient are
reported.
"""

from __future__ import annotations

import traceback
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import torch
from torch import Tensor
from torch.multiprocessing.reductions import StorageWeakRef
from torch.utils._python_dispatch import TorchDispatchMode
from torch.utils._pytree import tree_leaves

__all__ = ["Origin", "OriginsOfNotFinite", "is_finite"]

PACKAGE = Path(__file__).parents[1]
UNINITIALIZED = ("empty", "new_empty", "resize")
"""Prefixes of the names of operations that return uninitialised memory."""


@dataclass(frozen=True)
class Origin:
    """An operation that produced non-finite values out of finite ones.

    Attributes:
        order: number of such operations before it.
        operation: name of the operation in torch, such as `aten.div.Tensor`.
        derivative_of: name of the autograd node whose derivative it computes, such as `DivBackward0`; None in
            the forward pass.
        place: file, line and function of this package that called it, for a derivative those of the forward
            operation; None if it was not called by this package.
        code: source code of that line.
        broken: number of non-finite values in the result.
        values: number of values in the result.
        rows: indices along the first axis of the result that contain non-finite values.
        length: length of the first axis of the result.
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
    """A context manager that checks the result of every torch operation; see `origin_of`.

    Example:
        >>> with OriginsOfNotFinite() as origins:
        ...     x = torch.zeros(2)
        ...     y = (x / x) + 1.0
        >>> origins.origin_of(y).operation
        'aten.div.Tensor'
    """

    def __init__(self) -> None:
        super().__init__()
        self._origins: dict[StorageWeakRef, Origin] = {}
        self._count = 0

    def origin_of(self, value: Tensor) -> Origin | None:
        """The operation from which a NaN or infinity in a tensor originates.

        Returns None if the tensor is finite, or if its non-finite values come from outside of the context.
        """
        return None if is_finite(value) else self._origins.get(_storage(value))

    def __torch_dispatch__(self, func: Any, types: Any, args: Any = (), kwargs: Any = None) -> Any:
        bad_inputs = [_storage(value) for value in _tensors((args, kwargs)) if not is_finite(value)]
        origins = [self._origins[storage] for storage in bad_inputs if storage in self._origins]
        result = func(*args, **(kwargs or {}))
        uninitialized = func.__name__.startswith(UNINITIALIZED)
        for value in _tensors(result):
            if uninitialized:
                self._origins.pop(_storage(value), None)
            elif is_finite(value):
                continue
            elif origins:
                self._origins[_storage(value)] = min(origins, key=lambda origin: origin.order)
            elif not bad_inputs:
                # A bad input without a known origin comes from outside of the context, or from a compiled
                # loop, which is not a torch operation. Then this operation is not the origin either.
                self._origins[_storage(value)] = _origin(self._count, func, value)
                self._count += 1
        return result


def is_finite(value: Tensor) -> bool:
    """Whether all elements of a tensor are finite; always true for integers."""
    return not value.dtype.is_floating_point or bool(torch.isfinite(value).all())


def _tensors(nest: Any) -> Iterator[Tensor]:
    return (leaf for leaf in tree_leaves(nest) if isinstance(leaf, Tensor))


def _storage(value: Tensor) -> StorageWeakRef:
    """The storage of a tensor as a key; views of it and the results of in-place operations share it.

    The address of the storage would be no key: a new tensor may get the address of one that has been freed,
    and a NaN that a compiled loop writes there does not come from the origin of the old tensor.
    """
    return StorageWeakRef(value.untyped_storage())


def _origin(order: int, func: Any, value: Tensor) -> Origin:
    """Describe the current operation, whose result is `value`."""
    flat = value.detach().reshape(len(value) if value.ndim else 1, -1)
    is_bad = ~torch.isfinite(flat)
    rows = tuple(torch.nonzero(is_bad.any(1))[:, 0].tolist())
    node = torch._C._current_autograd_node()
    line = _line_of_forward(node) if node is not None else _line_here()
    return Origin(
        order=order,
        operation=str(func),
        derivative_of=None if node is None else node.name(),
        place=line.place,
        code=line.code,
        broken=int(is_bad.sum()),
        values=flat.numel(),
        rows=rows,
        length=len(flat),
    )


@dataclass(frozen=True)
class _Line:
    """A line of this package; without arguments, no line.

    Attributes:
        place: file, number and function.
        code: source code.
    """

    place: str | None = None
    code: str = ""


def _line_here() -> _Line:
    """The line of the innermost frame of this package on the call stack; no line if there is none."""
    for frame in reversed(traceback.extract_stack()):
        path = Path(frame.filename)
        if path.is_relative_to(PACKAGE) and path != Path(__file__):
            return _Line(f"{path.relative_to(PACKAGE)}:{frame.lineno} ({frame.name})", frame.line or "")
    return _Line()


def _line_of_forward(node: Any) -> _Line:
    """The line of this package that called the forward operation of an autograd node; no line if none did.

    Torch's anomaly mode stores the traceback, as lines of the form `File "…", line 3, in f`.
    """
    for entry in reversed(node.metadata.get("traceback_", [])):
        head, _, code = entry.strip().partition("\n")
        name, _, rest = head.removeprefix('File "').partition('", line ')
        number, _, function = rest.partition(", in ")
        if Path(name).is_relative_to(PACKAGE) and Path(name) != Path(__file__):
            return _Line(f"{Path(name).relative_to(PACKAGE)}:{number} ({function})", code.strip())
    return _Line()
