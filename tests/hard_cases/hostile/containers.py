"""Damage inside of containers: checksums, lengths and syntax of the damaged file are valid.

Most random damage to a PNG, a ZIP archive or a JSON text is refused by the checksum or by the parser, so that
the code behind them sees little of it. Here a chunk, a member or a value is damaged, and the file is put
together again.
"""

from __future__ import annotations

import io
import json
import struct
import zipfile
import zlib
from collections.abc import Callable
from typing import Any

import numpy as np

__all__ = ["damage_inside"]

Draw = np.random.Generator
Damage = Callable[[bytes, Draw], bytes]

PNG = b"\x89PNG\r\n\x1a\n"

VALUES = [
    *(None, True, False, 0, 1, -1, 0.5, 2**31, 2**63, -(2**70), 10**400, 1e308, 1e-320),
    *(float("nan"), float("inf"), float("-inf"), "", "nan", "1", "..", "../../../../etc/passwd"),
    *("/etc/passwd", "a\0b", "\n", "\ud800", "x" * 5000, [], {}, [[]], [None], {"a": 1}, [0.0] * 300),
]
"""What a JSON text may have in place of a value."""

DAMAGED_ALREADY = (
    *(ValueError, TypeError, KeyError, EOFError, OSError, RuntimeError, struct.error, zlib.error),
    *(zipfile.BadZipFile, OverflowError),
)
"""What parsers raise for a file that is damaged already."""


def damage_inside(data: bytes, draw: Draw, damage: Damage) -> bytes | None:
    """Damage a part of a container and repair checksums and lengths.

    Args:
        data: the whole file.
        draw: random numbers.
        damage: damages the bytes of a part.

    Returns:
        The file with the damaged part; None if the file is no container that is known here, or is damaged
        already.
    """
    try:
        if data.startswith(PNG):
            return _damage_png(data, draw, damage)
        if data.startswith(b"PK"):
            return _damage_zip(data, draw, damage)
        if data.startswith(b"glTF"):
            return _damage_glb(data, draw)
        if data.lstrip()[:1] in (b"{", b"["):
            return _damage_json(data, draw)
    except DAMAGED_ALREADY:
        pass
    return None


def _damage_png(data: bytes, draw: Draw, damage: Damage) -> bytes:
    chunks, place = [], len(PNG)
    while place < len(data):
        length, kind = struct.unpack_from(">I4s", data, place)
        chunks.append((kind, data[place + 8 : place + 8 + length]))
        place += 12 + length
    i = int(draw.integers(len(chunks)))
    kind, content = chunks[i]
    if kind == b"IDAT" and draw.random() < 0.5:
        content = zlib.compress(damage(zlib.decompress(content), draw))
    elif draw.random() < 0.9:
        content = damage(content, draw)
    else:
        kind = chunks[int(draw.integers(len(chunks)))][0]
    chunks[i] = (kind, content)
    return PNG + b"".join(
        struct.pack(">I4s", len(content), kind) + content + struct.pack(">I", zlib.crc32(kind + content))
        for kind, content in chunks
    )


def _damage_zip(data: bytes, draw: Draw, damage: Damage) -> bytes:
    with zipfile.ZipFile(io.BytesIO(data)) as whole:
        members = [(info, whole.read(info)) for info in whole.infolist()]
    i = int(draw.integers(len(members)))
    info, content = members[i]
    members[i] = (info, damage(content, draw))
    if draw.random() < 0.1:
        members[i] = (info, members[int(draw.integers(len(members)))][1])
    written = io.BytesIO()
    with zipfile.ZipFile(written, "w") as target:
        for info, content in members:
            target.writestr(info.filename, content, info.compress_type)
    return written.getvalue()


def _damage_glb(data: bytes, draw: Draw) -> bytes:
    """The JSON chunk, which comes first, with one other value."""
    length = struct.unpack_from("<I", data, 12)[0]
    text = _damage_json(data[20 : 20 + length], draw)
    text += b" " * (-len(text) % 4)
    rest = data[20 + length :]
    return data[:8] + struct.pack("<III", 20 + len(text) + len(rest), len(text), 0x4E4F534A) + text + rest


def _damage_json(data: bytes, draw: Draw) -> bytes:
    """Replace, remove, repeat or swap a value of a JSON text."""
    document: list[Any] = [json.loads(data)]
    places: list[tuple[Any, Any]] = []
    waiting: list[Any] = [document]
    while waiting:
        holder = waiting.pop()
        keys = list(holder) if isinstance(holder, dict) else range(len(holder))
        for key in keys:
            places.append((holder, key))
            if isinstance(holder[key], (dict, list)):
                waiting.append(holder[key])
    holder, key = places[int(draw.integers(len(places)))]
    kind = draw.random()
    if kind < 0.6:
        holder[key] = VALUES[int(draw.integers(len(VALUES)))]
    elif kind < 0.75:
        other, name = places[int(draw.integers(len(places)))]
        holder[key] = json.loads(json.dumps(other[name]))
    elif kind < 0.85 and holder is not document:
        del holder[key]
    elif kind < 0.9 and isinstance(holder, dict):
        holder[str(VALUES[int(draw.integers(len(VALUES)))])[:100]] = holder.pop(key)
    elif isinstance(holder[key], list):
        holder[key] *= int(draw.integers(2, 50))
    elif isinstance(holder[key], (int, float)):
        holder[key] = holder[key] * 10.0 ** int(draw.integers(-40, 40))
    return json.dumps(document[0]).encode("utf-8", "surrogatepass") if document else b""
