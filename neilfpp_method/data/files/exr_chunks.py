"""Whether OpenEXR has written a whole file: on a full disk, it may omit the last pixels without an error."""

from __future__ import annotations

import io
import struct
from pathlib import Path

__all__ = ["has_all_chunks"]

HEAD = 65_536
"""Bytes that contain the header and the table of chunks of a file that `write_exr` writes."""
ROWS = 16
"""Rows of a chunk with ZIP compression."""


def has_all_chunks(path: Path) -> bool:
    """Whether a file of one part, in rows with ZIP compression, ends where its last chunk ends.

    The header is a list of attributes (name, type, length, value), which ends with a zero. The positions of
    the chunks follow, and the chunks: first row, length, and data.
    """
    with path.open("rb") as file:
        head = file.read(HEAD)
        try:
            at, rows = 8, 0
            while (end := head.index(b"\0", at)) > at:
                name, at = head[at:end], head.index(b"\0", end + 1) + 1
                if name == b"dataWindow":
                    _, top, _, bottom = struct.unpack_from("<4i", head, at + 4)
                    rows = bottom - top + 1
                at += 4 + struct.unpack_from("<i", head, at)[0]
            positions = struct.unpack_from(f"<{-(-rows // ROWS)}Q", head, end + 1)
            file.seek(max(positions) + 4)
            length = struct.unpack("<i", file.read(4))[0]
        except (ValueError, struct.error):
            return False
        return all(positions) and file.seek(0, io.SEEK_END) == max(positions) + 8 + length
