"""Read arrays of numbers from a pickle of an untrusted source.

A pickle is a program that the usual reader executes. This reader accepts only the five names that NumPy uses
to pickle an array, and replaces each by a stand-in that only records its arguments. It rejects all other
names, so the file cannot call anything. The arrays are made from the recorded bytes after these have been
checked.
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
"""Largest size of a pickle. Poses and intrinsics take a few hundred bytes."""
NUMBERS = ("f4", "f8", "i4", "i8")
"""NumPy types of numbers that are accepted."""


def read_pickled_arrays(path: Path) -> tuple[Float64[np.ndarray, " *shape"], ...]:
    """Read a pickled tuple or list of arrays of numbers.

    Raises:
        UserError: the file contains something else, or is damaged.
    """
    try:
        with path.open("rb") as file:
            data = file.read(MAX_BYTES + 1)
        if len(data) > MAX_BYTES:
            raise ValueError("it is too large for a camera")
        for opcode, argument, _ in pickletools.genops(data):
            if opcode.name.endswith("PUT") and int(argument or 0) > len(data):
                # The unpickler would allocate memory for this number of objects.
                raise ValueError("damaged")
        arrays = _Arrays(io.BytesIO(data)).load()
        if not isinstance(arrays, tuple | list):
            raise ValueError("it is not a tuple of arrays")
        return tuple(_numbers(array) for array in arrays)
    except Exception as error:
        # A forged file can raise any exception in the unpickler.
        reason = (str(error).strip().splitlines() or [type(error).__name__])[0]
        raise UserError(
            f"{path}: not pickled arrays of numbers ({reason})", "write the camera again, as two arrays"
        ) from error


class _Type:
    """Stand-in for `numpy.dtype`."""

    def __init__(self, name: str = "", *_: Any) -> None:
        self.name, self.order = name, "<"

    def __setstate__(self, state: tuple) -> None:
        self.order = state[1]


class _Array:
    """Stand-in for `numpy.ndarray`, and for the function that constructs one."""

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
    # The oldest protocols write bytes as encoded text.
    ("_codecs", "encode"): _encode,
}
"""Stand-ins of the accepted names, by module and name."""


class _Arrays(pickle.Unpickler):
    def find_class(self, module: str, name: str) -> Callable[..., Any]:
        key = (module.replace("numpy._core", "numpy.core"), name)
        if key not in STAND_INS:
            raise pickle.UnpicklingError(f"it refers to {module}.{name}")
        return STAND_INS[key]


def _numbers(array: Any) -> Float64[np.ndarray, " *shape"]:
    if not isinstance(array, _Array) or array.state is None:
        raise ValueError("it contains something else")
    data, kind, shape, order = array.state
    if not isinstance(kind, _Type) or kind.name not in NUMBERS:
        raise ValueError("its numbers are of another type")
    byte_order = {"<": "<", "=": "<", ">": ">"}[kind.order]
    flat = np.frombuffer(bytes(memoryview(data)), dtype=byte_order + kind.name).astype(np.float64)
    return flat.reshape(tuple(map(int, shape)), order={"C": "C", "F": "F"}[order])
