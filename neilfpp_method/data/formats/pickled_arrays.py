"""Arrays of numbers from a pickle that a stranger may have written.

A pickle is a program, and the usual reader runs it. This one knows the five names by which NumPy pickles an
array, gives each a stand-in of its own that only notes down what it is handed, and refuses all other names:
nothing that a file says is called, and NumPy itself sees no more than checked bytes in the end.
"""

from __future__ import annotations

import io
import pickle
import pickletools
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float64

from neilfpp_method.errors import UserError

__all__ = ["read_pickled_arrays"]

MAX_BYTES = 2**16
"""Size of a pickle; poses and intrinsics take a few hundred bytes."""
NUMBERS = ("f4", "f8", "i4", "i8")


def read_pickled_arrays(path: Path) -> tuple[Float64[np.ndarray, " *shape"], ...]:
    """The arrays of a pickled tuple or list of arrays of numbers.

    Raises:
        UserError: it is something else, or damaged.
    """
    try:
        with path.open("rb") as file:
            data = file.read(MAX_BYTES + 1)
        if len(data) > MAX_BYTES:
            raise ValueError("it is too large for a camera")
        for opcode, argument, _ in pickletools.genops(data):
            if opcode.name.endswith("PUT") and int(argument or 0) > len(data):
                raise ValueError(
                    "damaged"
                )  # the unpickler makes room for as many objects as such a number says
        arrays = _Arrays(io.BytesIO(data)).load()
        if not isinstance(arrays, tuple | list):
            raise ValueError("it is no tuple of arrays")
        return tuple(_numbers(array) for array in arrays)
    except Exception as error:  # a forged file can fail anywhere in the unpickler
        reason = (str(error).strip().splitlines() or [type(error).__name__])[0]
        raise UserError(
            f"{path}: no pickled arrays of numbers ({reason})", "write the camera again, as two arrays"
        ) from error


class _Type:
    """Stands in for numpy.dtype."""

    def __init__(self, name: str = "", *_: Any) -> None:
        self.name, self.order = name, "<"

    def __setstate__(self, state: tuple) -> None:
        self.order = state[1]


class _Array:
    """Stands in for numpy.ndarray, and for what makes one."""

    def __init__(self, *_: Any) -> None:
        self.state: tuple | None = None

    def __setstate__(self, state: tuple) -> None:
        _, shape, kind, columns_first, data = state
        self.state = (data, kind, shape, "F" if columns_first else "C")


def _from_buffer(data: Any, kind: Any, shape: Any, order: Any) -> _Array:
    array = _Array()
    array.state = (data, kind, shape, order)
    return array


def _encode(text: str, encoding: str) -> bytes:
    return text.encode({"latin1": "latin1"}[encoding])


STAND_INS: dict[tuple[str, str], Callable[..., Any]] = {
    ("numpy", "ndarray"): _Array,
    ("numpy", "dtype"): _Type,
    ("numpy.core.multiarray", "_reconstruct"): _Array,
    ("numpy.core.numeric", "_frombuffer"): _from_buffer,
    ("_codecs", "encode"): _encode,  # how bytes are said in the oldest protocols
}


class _Arrays(pickle.Unpickler):
    def find_class(self, module: str, name: str) -> Callable[..., Any]:
        key = (module.replace("numpy._core", "numpy.core"), name)
        if key not in STAND_INS:
            raise pickle.UnpicklingError(f"it asks for {module}.{name}")
        return STAND_INS[key]


def _numbers(array: Any) -> Float64[np.ndarray, " *shape"]:
    if not isinstance(array, _Array) or array.state is None:
        raise ValueError("it holds something else")
    data, kind, shape, order = array.state
    if not isinstance(kind, _Type) or kind.name not in NUMBERS:
        raise ValueError("its numbers are of another type")
    byte_order = {"<": "<", "=": "<", ">": ">"}[kind.order]
    flat = np.frombuffer(bytes(memoryview(data)), dtype=byte_order + kind.name).astype(np.float64)
    return flat.reshape(tuple(map(int, shape)), order={"C": "C", "F": "F"}[order])
