"""The checks of the campaign notice truncated files, and files with another content."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path

import cv2
import numpy as np
import pytest
import trimesh

from neilfpp_method.data.files.images import write_exr, write_png
from tests.hard_cases.faults.campaign import Report, check_files, compare_files
from tests.hard_cases.faults.whole_files import comparable_files

NUMBERS = np.random.default_rng(0).random((48, 64, 3), np.float32)
BYTES = (255 * NUMBERS).astype(np.uint8)


def write_film(path: Path) -> None:
    film = cv2.VideoWriter(str(path), cv2.VideoWriter_fourcc(*"mp4v"), 24, (64, 48))
    for shift in range(3):
        film.write(np.roll(BYTES, shift, 0))
    film.release()


WRITERS: dict[str, Callable[[Path], object]] = {
    ".json": lambda path: path.write_text(json.dumps({"views": ["000"]})),
    ".png": lambda path: write_png(path, BYTES),
    ".exr": lambda path: write_exr(path, {"RGB": NUMBERS}),
    ".npy": lambda path: np.save(path, NUMBERS),
    ".npz": lambda path: np.savez(path, one=NUMBERS, other=BYTES),
    ".html": lambda path: path.write_text("<!doctype html><html><body>report</body></html>"),
    ".usda": lambda path: path.write_text('#usda 1.0\ndef Mesh "surface"\n{\n    double size = 1.5\n}'),
    ".ply": lambda path: trimesh.creation.box().export(path),
    ".glb": lambda path: trimesh.creation.box().export(path),
    ".mp4": write_film,
}


def faults(folder: Path) -> list[str]:
    report = Report()
    check_files(report, "render, SIGKILL", folder)
    return report.faults


@pytest.mark.parametrize("suffix", WRITERS)
def test_a_truncated_file_is_noticed(tmp_path, suffix):
    path = tmp_path / f"file{suffix}"
    WRITERS[suffix](path)
    assert faults(tmp_path) == []
    content = path.read_bytes()
    for length in (0, 1, len(content) // 2, len(content) - 1):
        path.write_bytes(content[:length])
        assert [fault.split(":")[1] for fault in faults(tmp_path)] == [f" file{suffix} is not whole"], length


def test_files_with_another_content_are_noticed(tmp_path):
    for name, took, samples in (("one", 1.0, 4), ("other", 2.0, 4), ("third", 2.0, 5)):
        (tmp_path / name).mkdir()
        (tmp_path / name / "000.json").write_text(json.dumps({"samples": samples, "took": took}))
        (tmp_path / name / ".000.7.exr").write_text(name)  # is being written
    one, other, third = (comparable_files(tmp_path / name) for name in ("one", "other", "third"))
    report = Report()
    compare_files(report, "relight", other, one)  # only the time differs
    assert report.faults == []
    compare_files(report, "relight", third, one)
    compare_files(report, "relight", {}, one)
    compare_files(report, "relight", one, {})
    assert len(report.faults) == 3
    assert all("000.json is not that of a command" in fault for fault in report.faults)
