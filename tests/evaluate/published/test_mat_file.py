"""Matlab files against SciPy's writer, and damaged ones."""

from __future__ import annotations

import struct
import time
import zlib
from pathlib import Path

import numpy as np
import pytest
from scipy.io import savemat

from neilfpp_method.errors import UserError
from neilfpp_method.evaluate.published.mat_file import read_matrices


@pytest.mark.parametrize("compressed", [False, True])
@pytest.mark.parametrize("kind", ["f8", "f4", "i1", "u1", "i2", "u2", "i4", "u4", "i8", "u8"])
def test_arrays_are_those_that_scipy_writes(tmp_path: Path, compressed: bool, kind: str) -> None:
    written = {
        "cube": (np.arange(60).reshape(3, 4, 5)).astype(kind),
        "one": np.array([[7]], kind),
        "none": np.zeros((0, 3), kind),
    }
    path = tmp_path / "a.mat"
    savemat(path, {"text": "is skipped", **written}, do_compression=compressed)
    found = read_matrices(path, {"cube": 3, "one": 2, "none": 2})
    for name, values in written.items():
        assert found[name].dtype == values.dtype
        assert np.array_equal(found[name], values)


def refused(path: Path, **wanted: int) -> str:
    with pytest.raises(UserError) as caught:
        read_matrices(path, wanted)
    assert "\n" not in str(caught.value)
    return str(caught.value)


def test_other_contents_are_refused(tmp_path: Path) -> None:
    path = tmp_path / "a.mat"
    savemat(path, {"a": np.eye(2), "text": "word", "complex": np.eye(2) * 1j, "cell": np.array([{}], object)})
    assert "b is missing" in refused(path, b=2)
    for name, axes in {"a": 3, "text": 2, "complex": 2, "cell": 2}.items():
        refused(path, **{name: axes})
    path.write_bytes(path.read_bytes()[:100])
    refused(path, a=2)
    path.write_text("no Matlab file")
    refused(path, a=2)


@pytest.mark.parametrize("place", ["matrix", "values"])
def test_a_length_beyond_the_file_allocates_nothing(tmp_path: Path, place: str) -> None:
    path = tmp_path / "a.mat"
    savemat(path, {"a": np.eye(3)})
    data = bytearray(path.read_bytes())
    at = 128 if place == "matrix" else data.index(struct.pack("<II", 9, 72))
    struct.pack_into("<I", data, at + 4, 2**31)
    path.write_bytes(data)
    assert "2147483648 bytes" in refused(path, a=2)


def test_values_without_bytes_do_not_crash(tmp_path: Path) -> None:
    """SciPy 1.17 reads from a null pointer."""
    path = tmp_path / "a.mat"
    savemat(path, {"a": np.eye(3)})
    data = path.read_bytes()
    begin = data.index(struct.pack("<II", 9, 72))
    path.write_bytes(data[:begin])
    refused(path, a=2)


def test_millions_of_tiny_elements_are_not_unpacked(tmp_path: Path) -> None:
    path = tmp_path / "a.mat"
    savemat(path, {"a": np.eye(3)})
    data = path.read_bytes()
    parts = data[136:] + bytes(2**26)  # flags, axes, name and values of the array, then empty elements
    deflated = zlib.compress(struct.pack("<II", 14, len(parts)) + parts)
    path.write_bytes(data[:128] + struct.pack("<II", 15, len(deflated)) + deflated)
    began = time.process_time()
    assert "too many values" in refused(path, a=2)
    assert time.process_time() - began < 1.0
