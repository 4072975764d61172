"""Arrays of untrusted NPY and NPZ files."""

from __future__ import annotations

import io
import struct
import zipfile
from pathlib import Path

import numpy as np
import pytest

from neilfpp_method.data.files.number_arrays import array_of, arrays_of_archive


def npy(values: np.ndarray) -> bytes:
    file = io.BytesIO()
    np.save(file, values)
    return file.getvalue()


def with_header(text: str, values: bytes = b"") -> bytes:
    """An NPY file with any header."""
    return b"\x93NUMPY\x01\x00" + struct.pack("<H", len(text)) + text.encode() + values


@pytest.mark.parametrize(
    "values",
    [
        np.arange(6.0).reshape(2, 3),
        np.arange(6, dtype=">i2"),
        np.array(3),
        np.array("text"),
        np.zeros((0, 3)),
    ],
)
def test_arrays_are_read(values):
    for stored in (values, np.asarray(values, order="F")):
        found = array_of(npy(stored))
        assert found.dtype == values.dtype
        assert np.array_equal(found, values)


HEADER = "{'descr': '%s', 'fortran_order': False, 'shape': %s}"


@pytest.mark.parametrize(
    "data",
    [
        b"",
        b"not an array",
        npy(np.arange(6.0))[:-1],
        with_header(HEADER % ("<f4", "(1000000000000,)")),
        with_header(HEADER % ("<f4", "(-1, -1)"), bytes(4)),
        with_header(HEADER % ("|O", "()"), b"cos\nsystem\n"),
        with_header("{'descr': '<f4', ", bytes(4)),  # raises tokenize.TokenError in NumPy
        with_header(HEADER % ("<U500000000", "(0,)")),
        with_header("{" * 3000),
        with_header("  x\n y"),
    ],
)
def test_damaged_arrays_are_refused_in_one_line(data):
    with pytest.raises(ValueError, match=r"\A.+\Z"):
        array_of(data)


def archive(path: Path, **members: bytes) -> Path:
    with zipfile.ZipFile(path, "w", zipfile.ZIP_DEFLATED) as file:
        for name, data in members.items():
            file.writestr(f"{name}.npy", data)
    return path


def test_archives_are_read_and_bounded(tmp_path):
    path = archive(tmp_path / "a.npz", one=npy(np.arange(3)), other=npy(np.ones(2)))
    found = arrays_of_archive(path, 2000)
    assert found["one"].tolist() == [0, 1, 2]
    assert found["other"].tolist() == [1, 1]
    bomb = archive(tmp_path / "bomb.npz", zeros=npy(np.zeros(10**6)))
    assert bomb.stat().st_size < 20_000
    with pytest.raises(ValueError, match="more than 20000 bytes"):
        arrays_of_archive(bomb, 20_000)


def test_damaged_archives_are_refused_in_one_line(tmp_path):
    path = archive(tmp_path / "a.npz", one=npy(np.arange(3)), text=b"no array, which NumPy returns as bytes")
    with pytest.raises(ValueError, match=r"\A.+\Z"):
        arrays_of_archive(path, 2000)
    newer = bytearray(archive(tmp_path / "newer.npz", one=npy(np.arange(3))).read_bytes())
    newer[newer.index(b"PK\1\2") + 6] = 127  # the version that is needed to unpack: NotImplementedError
    (tmp_path / "newer.npz").write_bytes(newer)
    with pytest.raises(ValueError, match=r"12\.7"):
        arrays_of_archive(tmp_path / "newer.npz", 2000)


def test_other_ways_of_compression_are_refused(tmp_path):
    """LZMA's dictionary may ask for four gigabytes."""
    with zipfile.ZipFile(tmp_path / "a.npz", "w", zipfile.ZIP_LZMA) as file:
        file.writestr("one.npy", npy(np.arange(3)))
    with pytest.raises(ValueError, match="another way"):
        arrays_of_archive(tmp_path / "a.npz", 2000)


def test_a_member_that_is_larger_than_the_file_is_refused(tmp_path):
    """Zipfile allocates two gigabytes for it."""
    data = bytearray(archive(tmp_path / "a.npz", one=npy(np.arange(3))).read_bytes())
    struct.pack_into("<I", data, data.index(b"PK\1\2") + 20, 2**32 - 2)
    (tmp_path / "a.npz").write_bytes(data)
    with pytest.raises(ValueError, match="larger than the file"):
        arrays_of_archive(tmp_path / "a.npz", 2000)
