"""Read arrays of numbers from Matlab files (version 5, which Matlab 6 and 7 write) of untrusted sources.

SciPy's reader allocates what a file asks for and can crash on a damaged one. This one reads only what a
dataset needs: real arrays of numbers.

    header                  128 bytes; the last four are the version and the byte order
    element                 type and length, 4 bytes each, and the content, padded to 8 bytes; up to 4 bytes
                              of content may take the place of the padding, with the length in the upper half
                              of the type
    element COMPRESSED      one element, deflated, not padded
    element MATRIX          elements: flags and class, lengths of the axes, name, values column by column
"""

from __future__ import annotations

import math
import struct
import zlib
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from itertools import islice
from pathlib import Path

import numpy as np

from neilfpp_method.errors import UserError

__all__ = ["read_matrices"]

HEADER = 128
MATRIX, COMPRESSED = 14, 15
TYPES = {1: "i1", 2: "u1", 3: "i2", 4: "u2", 5: "i4", 6: "u4", 7: "f4", 9: "f8", 12: "i8", 13: "u8"}
"""NumPy's types of numbers by the type of an element. The values of an array may have a smaller one."""
CLASSES = dict(enumerate(("f8", "f4", "i1", "u1", "i2", "u2", "i4", "u4", "i8", "u8"), start=6))
"""NumPy's types of arrays by class. Other classes are cells, structures, objects, text and sparse arrays."""
COMPLEX = 0x0800
LARGEST_ELEMENT = 2**28
"""Largest number of unpacked bytes of an element; the masks of DTU have up to 30 million."""


def read_matrices(path: Path, wanted: Mapping[str, int]) -> dict[str, np.ndarray]:
    """Read arrays of numbers; `wanted` maps names to numbers of axes.

    Raises:
        UserError: the file is damaged, or an array is missing, too large, or of another kind.
    """
    found = {}
    try:
        data = memoryview(path.read_bytes())
        order = {b"IM": "<", b"MI": ">"}[bytes(data[HEADER - 2 : HEADER])]
        for element in _elements(data[HEADER:], order):
            if element.kind == COMPRESSED:
                unpacked = zlib.decompressobj().decompress(element.content, LARGEST_ELEMENT)
                element = next(_elements(memoryview(unpacked), order))
            if element.kind != MATRIX:
                continue
            parts = _elements(element.content, order)
            flags, axes, name = islice(parts, 3)
            if (word := bytes(name.content).decode("latin-1")) in wanted:
                (values,) = parts
                found[word] = _numbers(flags, axes, values, order, wanted[word])
    except Exception as error:
        # Forged bytes can raise many types of exceptions when they are unpacked.
        raise UserError(
            f"{path}: cannot be read as Matlab's arrays ({error!r})", "download the SampleSet again"
        ) from error
    if missing := wanted.keys() - found.keys():
        raise UserError(f"{path}: {min(missing)} is missing", "download the SampleSet again")
    return found


@dataclass(frozen=True)
class _Element:
    """An element: its type and its content."""

    kind: int
    content: memoryview


def _elements(block: memoryview, order: str) -> Iterator[_Element]:
    while len(block):
        kind, length = struct.unpack_from(f"{order}II", block)
        begin, padding = 8, 0 if kind == COMPRESSED else -length % 8
        if kind >> 16:
            kind, length, begin = kind & 0xFFFF, kind >> 16, 4
            padding = 4 - length
        if padding < 0 or length > len(block) - begin:
            raise ValueError(f"an element of {length} bytes, but {len(block) - begin} are left")
        yield _Element(kind, block[begin : begin + length])
        block = block[begin + length + padding :]


def _numbers(flags: _Element, axes: _Element, values: _Element, order: str, expected_axes: int) -> np.ndarray:
    """The array of a matrix element."""
    (word,) = struct.unpack_from(f"{order}I", flags.content)
    shape = tuple(np.frombuffer(axes.content, f"{order}i4").tolist())
    if word & COMPLEX or len(shape) != expected_axes or min(shape) < 0:
        raise ValueError(f"an array of the shape {shape}")
    flat = np.frombuffer(values.content, order + TYPES[values.kind])
    if len(flat) != math.prod(shape):
        raise ValueError(f"{len(flat)} numbers for the shape {shape}")
    return flat.reshape(shape, order="F").astype(CLASSES[word & 0xFF])
