"""Read arrays of numbers from NPY and NPZ files of untrusted sources.

NumPy allocates the memory that a header asks for, raises many types of exceptions for damaged headers, and
returns the raw bytes of a member of an archive that is not an array. This module makes an array only if the
file has as many bytes as its header says.
"""

from __future__ import annotations

import io
import math
import zipfile
from pathlib import Path

import numpy as np

__all__ = ["array_of", "arrays_of_archive"]

HEADER_READERS = {
    (1, 0): np.lib.format.read_array_header_1_0,
    (2, 0): np.lib.format.read_array_header_2_0,
}
"""Readers of the header by version of the format. Version 3 only adds names of fields that are not ASCII."""
NUMBERS_AND_TEXT = "biufU"
"""NumPy's kinds of the types that are accepted: no Python objects, which would be pickled, and no records."""

NUMPYS_COMPRESSION = (zipfile.ZIP_STORED, zipfile.ZIP_DEFLATED)
"""Other ways of compression, such as LZMA, can ask for gigabytes to unpack a few bytes."""


def array_of(data: bytes) -> np.ndarray:
    """Return the array of the contents of an NPY file.

    Raises:
        ValueError: the file is damaged, or contains something else than numbers or text.
    """
    try:
        file = io.BytesIO(data)
        shape, columns_first, kind = HEADER_READERS[np.lib.format.read_magic(file)](file)
        begin = file.tell()
        # NumPy allocates one value also for an array without values.
        if kind.kind not in NUMBERS_AND_TEXT or kind.itemsize > len(data):
            raise ValueError(f"values of the type {kind}")
        if math.prod(shape) * kind.itemsize != len(data) - begin:
            raise ValueError(f"{len(data) - begin} bytes for {kind} of the shape {shape}")
        # An array without bytes has no buffer to read.
        flat = np.frombuffer(data, kind, offset=begin) if len(data) > begin else np.empty(0, kind)
        return flat.reshape(shape, order="F" if columns_first else "C").copy()
    except Exception as error:
        # A forged header can raise any exception: NumPy evaluates it as Python source of a dictionary.
        raise ValueError(_line(error)) from error


def arrays_of_archive(path: Path, max_bytes: int) -> dict[str, np.ndarray]:
    """Return the arrays of an NPZ file by name.

    Args:
        path: the file.
        max_bytes: largest size of all arrays together, unpacked.

    Raises:
        ValueError: the file cannot be read, is damaged, contains something else than arrays of numbers and
            text, or is too large. The message is one line.
    """
    try:
        with zipfile.ZipFile(path) as packed:
            members = packed.infolist()
            if any(member.compress_type not in NUMPYS_COMPRESSION for member in members):
                raise ValueError("compressed in another way than NumPy compresses")
            # zipfile reads, and allocates, as many bytes at once.
            if any(member.compress_size > path.stat().st_size for member in members):
                raise ValueError("a member is larger than the file")
            if sum(member.file_size for member in members) > max_bytes:
                raise ValueError(f"more than {max_bytes} bytes")
            contents = {member.filename.removesuffix(".npy"): packed.read(member) for member in members}
        return {name: array_of(data) for name, data in contents.items()}
    except Exception as error:
        # For a damaged archive, zipfile and zlib raise many types of exceptions.
        raise ValueError(_line(error)) from error


def _line(error: Exception) -> str:
    return " ".join(str(error).split())[:200] or type(error).__name__
