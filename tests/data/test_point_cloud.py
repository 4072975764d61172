"""Oriented point clouds: positions in the scene frame, unit normals, and variants of PLY."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import torch
import trimesh

from neilfpp_method.data.capture import load_capture
from neilfpp_method.data.point_cloud import (
    WorldPoints,
    load_point_cloud,
    read_oriented_ply,
    read_positions,
    write_oriented_ply,
)
from neilfpp_method.errors import UserError
from tests.data.make_capture import RADIUS, SCALE, make_capture, write_ply

POSITION = np.array([[1.0, 2.0, 3.0], [4.0, 5.0, 6.0]])
NORMAL = np.array([[0.0, 0.0, 2.0], [1.0, 0.0, 0.0]])


def test_points_of_the_sphere_in_the_scene_frame(tmp_path: Path) -> None:
    capture = load_capture(make_capture(tmp_path))
    points = load_point_cloud(capture.point_cloud, capture.normalization)
    assert len(points) == 500
    assert torch.allclose(points.position.norm(dim=-1), torch.tensor(RADIUS / SCALE), atol=1e-6)
    assert torch.allclose(points.normal, torch.nn.functional.normalize(points.position, dim=-1), atol=1e-5)


@pytest.mark.parametrize("dialect", ["ascii", "big_endian", "colors_and_faces"])
def test_variants_of_ply(tmp_path: Path, dialect: str) -> None:
    names = ("x", "y", "z", "nx", "ny", "nz")
    rows = np.concatenate([POSITION, NORMAL], axis=1)
    path = tmp_path / "cloud.ply"
    if dialect == "ascii":
        head = "ply\nformat ascii 1.0\ncomment hello\nelement vertex 2\n"
        head += "".join(f"property double {name}\n" for name in names) + "end_header\n"
        path.write_text(head + "\n".join(" ".join(map(str, row)) for row in rows) + "\n")
    elif dialect == "big_endian":
        head = "ply\r\nformat binary_big_endian 1.0\r\nelement vertex 2\r\n"
        head += "".join(f"property float32 {name}\r\n" for name in names) + "end_header\r\n"
        path.write_bytes(head.encode() + rows.astype(">f4").tobytes())
    else:
        head = "ply\nformat binary_little_endian 1.0\nelement vertex 2\nproperty uchar red\n"
        head += "".join(f"property float {name}\n" for name in names)
        head += "element face 1\nproperty list uchar int vertex_indices\nend_header\n"
        table = np.zeros(2, [("red", "u1"), *((name, "<f4") for name in names)])
        for name, column in zip(names, rows.T, strict=True):
            table[name] = column
        path.write_bytes(head.encode() + table.tobytes() + b"\3" + np.array([0, 1, 0], "<i4").tobytes())
    points = read_oriented_ply(path)
    assert np.array_equal(points.position, POSITION)
    assert np.array_equal(points.normal, NORMAL)


@pytest.mark.parametrize(("offset", "kind"), [(0.0, "float"), (4e6, "double")])
def test_written_points_keep_their_positions(tmp_path: Path, offset: float, kind: str) -> None:
    random = np.random.default_rng(0)
    normal = random.normal(size=(50, 3))
    points = WorldPoints(offset + random.uniform(size=(50, 3)), normal.astype(np.float32).astype(np.float64))
    path = write_oriented_ply(tmp_path / "cloud.ply", points)
    again = read_oriented_ply(path)
    assert np.abs(again.position - points.position).max() < 1e-6
    assert np.array_equal(again.normal, points.normal)
    assert f"property {kind} x\n".encode() in path.read_bytes()
    # Another program reads the same file.
    mesh = trimesh.load(path)
    assert np.abs(np.asarray(mesh.vertices) - points.position).max() < 1e-6


def test_an_empty_cloud_is_written(tmp_path: Path) -> None:
    path = write_oriented_ply(tmp_path / "cloud.ply", WorldPoints(np.empty((0, 3)), np.empty((0, 3))))
    assert b"element vertex 0\nproperty float x\n" in path.read_bytes()


@pytest.mark.parametrize(
    ("break_file", "complaint"),
    [
        (lambda data: data.replace(b"property float nx\n", b""), "the points have no nx"),
        (lambda data: data[:-4], "not a PLY file that can be read"),
        (lambda data: data.replace(b"vertex 2", b"vertex 99999999999"), "not a PLY file that can be read"),
        (lambda data: data.replace(b"vertex 2", b"vertex -1"), "not a PLY file that can be read"),
        (lambda data: data.replace(b"vertex 2", b"vertex 0"), "no points"),
        (lambda data: data.replace(b"float x", b"quad x"), "not a PLY file that can be read"),
        (lambda data: data.replace(b"format binary", b"comment"), "no format"),
        (lambda data: b"", "no PLY header"),
    ],
)
def test_broken_files(tmp_path: Path, break_file, complaint: str) -> None:
    path = tmp_path / "cloud.ply"
    write_ply(path, POSITION, NORMAL)
    path.write_bytes(break_file(path.read_bytes()))
    with pytest.raises(UserError, match=rf"cloud\.ply: .*{complaint}"):
        read_oriented_ply(path)


@pytest.mark.parametrize("bad", [np.nan, np.inf])
def test_numbers_that_are_not_finite(tmp_path: Path, bad: float) -> None:
    write_ply(tmp_path / "a.ply", np.where(POSITION == 5, bad, POSITION), NORMAL)
    write_ply(tmp_path / "b.ply", POSITION, NORMAL * [[1], [0]])
    write_ply(tmp_path / "c.ply", POSITION, np.vstack((NORMAL[:1], np.full((1, 3), bad))))
    for name in ("a", "b", "c"):
        with pytest.raises(UserError, match=rf"{name}\.ply: 1 of 2 points"):
            read_oriented_ply(tmp_path / f"{name}.ply")


def test_more_points_than_a_file_can_have(tmp_path: Path) -> None:
    """NumPy takes no number beyond 64 bits, and no file has so many bytes."""
    path = tmp_path / "a.ply"
    for kind in ("ascii", "binary_little_endian"):
        path.write_text(f"ply\nformat {kind} 1.0\nelement vertex {9**30}\nproperty float x\nend_header\n1\n")
        with pytest.raises(UserError, match="states 42391158275216203514294433201 points"):
            read_positions(path)
