"""Check the structure of a PNG file before a library decodes it."""

from __future__ import annotations

import struct
from pathlib import Path

__all__ = ["check_png_chunks"]

SIGNATURE_LENGTH = 8
CHUNK = struct.Struct(">I4s")
"""Length of the data of a chunk, and its type. A checksum of four bytes follows the data."""
CHECKSUM_LENGTH = 4


def check_png_chunks(path: Path) -> None:
    """Check that the chunks of a PNG file fit into it.

    OpenCV allocates the length that a chunk states before it reads the chunk.

    Raises:
        ValueError: a chunk is longer than the rest of the file.
    """
    size = path.stat().st_size
    with path.open("rb") as file:
        position = SIGNATURE_LENGTH
        while position < size:
            file.seek(position)
            head = file.read(CHUNK.size)
            if len(head) < CHUNK.size:
                raise ValueError("it ends within the head of a chunk")
            length, kind = CHUNK.unpack(head)
            position += CHUNK.size + length + CHECKSUM_LENGTH
            if position > size:
                raise ValueError("a chunk is longer than the file")
            if kind == b"IEND":
                return
