"""Damage to files by number: the same number gives the same damage, so that a fault can be reproduced."""

from __future__ import annotations

import struct
from collections.abc import Callable

import numpy as np

from tests.hard_cases.hostile.containers import damage_inside

__all__ = ["mutated"]

Draw = np.random.Generator

COUNTS = [0, 1, -1, 2**7, 2**15, 2**16 - 1, 2**24, 2**31 - 1, -(2**31), 2**32 - 1, 2**53, 2**63 - 1]
"""Numbers that a reader may take for a size or a count."""
FLOATS = [float("nan"), float("inf"), float("-inf"), 0.0, -1.0, 1e-45, 1e38, 1e308, -1e300]
WORDS = [
    *("NaN", "Infinity", "-Infinity", "null", "true", "[]", "{}", '""', "-1", "0", "1e999", "0.5"),
    *("99999999999", "'", '"', ",", ":", "[", "{", "\\", "\x00", "\n", "\ufeff", "~", "&a", "*a"),
    *("../../../../etc/passwd", "/etc/passwd", "..", '"../../../../etc/passwd"', '"/etc/passwd"'),
    *("<script>alert(1)</script>", "!!python/object:os.system", "!!timestamp 2001-13-45", "!!bool maybe"),
    *("9" * 400, "9" * 5000, "[" * 5000, "x" * 5000),
]
"""What a text may say in the place of a number or a word."""


def mutated(data: bytes, number: int) -> bytes:
    """Return the damaged contents of a file: one to three of the kinds of damage below.

    Half of the damage to a container is done inside of it, with checksums and lengths made valid again.
    """
    draw = np.random.default_rng([number, len(data)])
    for _ in range(int(draw.choice([1, 1, 2, 3]))):
        inside = damage_inside(data, draw, _damaged) if draw.random() < 0.5 else None
        data = _damaged(data, draw) if inside is None else inside
    return data


def _damaged(data: bytes, draw: Draw) -> bytes:
    kinds = DAMAGES + (TEXT_DAMAGES if _is_text(data) else ())
    return kinds[draw.integers(len(kinds))](data, draw)


def _is_text(data: bytes) -> bool:
    return not any(data[:4096].translate(None, bytes(range(32, 127)) + b"\r\n\t"))


def _place(data: bytes, draw: Draw) -> int:
    """Half of all damage is done to the first kilobyte, where headers are."""
    end = min(len(data), 1024) if draw.random() < 0.5 else len(data)
    return int(draw.integers(end + 1))


def _flip_bits(data: bytes, draw: Draw) -> bytes:
    changed = bytearray(data)
    for _ in range(int(draw.integers(1, 9)) if data else 0):
        changed[min(_place(data, draw), len(data) - 1)] ^= 1 << int(draw.integers(8))
    return bytes(changed)


def _cut_off(data: bytes, draw: Draw) -> bytes:
    return data[: _place(data, draw)]


def _write_count(data: bytes, draw: Draw) -> bytes:
    order, code = "<>"[draw.integers(2)], "BHIQ"[draw.integers(4)]
    size = struct.calcsize(code)
    value = COUNTS[draw.integers(len(COUNTS))] % 2 ** (8 * size)
    return _overwrite(data, struct.pack(order + code, value), draw)


def _write_float(data: bytes, draw: Draw) -> bytes:
    kind = "<>"[draw.integers(2)] + ("f4", "f8")[draw.integers(2)]
    with np.errstate(over="ignore"):
        value = np.array(FLOATS[draw.integers(len(FLOATS))]).astype(kind)
    return _overwrite(data, value.tobytes(), draw)


def _overwrite(data: bytes, value: bytes, draw: Draw) -> bytes:
    place = _place(data, draw)
    return data[:place] + value + data[place + len(value) :]


def _chunk(data: bytes, draw: Draw) -> slice:
    start = _place(data, draw)
    return slice(start, start + int(draw.integers(1, 65)))


def _swap_chunks(data: bytes, draw: Draw) -> bytes:
    one, other = sorted((_chunk(data, draw), _chunk(data, draw)), key=lambda chunk: chunk.start)
    if one.stop > other.start:
        return data[: one.start] + data[one.start : other.stop][::-1] + data[other.stop :]
    between = data[one.stop : other.start]
    return data[: one.start] + data[other] + between + data[one] + data[other.stop :]


def _repeat_chunk(data: bytes, draw: Draw) -> bytes:
    chunk = _chunk(data, draw)
    return data[: chunk.stop] + data[chunk] * int(draw.integers(1, 64)) + data[chunk.stop :]


def _drop_chunk(data: bytes, draw: Draw) -> bytes:
    chunk = _chunk(data, draw)
    return data[: chunk.start] + data[chunk.stop :]


def _zero_chunk(data: bytes, draw: Draw) -> bytes:
    chunk = _chunk(data, draw)
    return data[: chunk.start] + b"\0" * len(data[chunk]) + data[chunk.stop :]


def _append(data: bytes, draw: Draw) -> bytes:
    return data + draw.bytes(int(draw.integers(1, 4096)))


def _say_another_word(data: bytes, draw: Draw) -> bytes:
    """Replace a word by another one; words end at spaces and JSON punctuation."""
    ends = [i for i, sign in enumerate(data) if sign in b" \n\t,:[]{}"]
    if len(ends) < 2:
        return data
    i = int(draw.integers(len(ends) - 1))
    word = WORDS[draw.integers(len(WORDS))].encode()
    return data[: ends[i] + 1] + word + data[ends[i + 1] :]


def _drop_line(data: bytes, draw: Draw) -> bytes:
    lines = data.splitlines(keepends=True)
    if lines:
        del lines[draw.integers(len(lines))]
    return b"".join(lines)


DAMAGES: tuple[Callable[[bytes, Draw], bytes], ...] = (
    _flip_bits, _flip_bits, _cut_off, _write_count, _write_count, _write_float, _swap_chunks, _repeat_chunk,
    _drop_chunk, _zero_chunk, _append,
)  # fmt: skip
TEXT_DAMAGES: tuple[Callable[[bytes, Draw], bytes], ...] = (_say_another_word,) * 8 + (_drop_line,)
