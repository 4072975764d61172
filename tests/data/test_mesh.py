"""Meshes: vertices in the scene frame."""

from __future__ import annotations

import json
import logging
from pathlib import Path

import numpy as np
import pytest
import trimesh

from neilfpp_method.data.mesh import read_mesh
from neilfpp_method.data.views import Normalization
from neilfpp_method.errors import UserError
from neilfpp_method.evaluate.published.dtu import _points

UNIT = Normalization(1.0, (0.0, 0.0, 0.0))


def test_vertices_far_from_the_origin_keep_their_precision(tmp_path: Path) -> None:
    """Map coordinates: at 5 200 000 m, single precision rounds to 0.5 m."""
    center = np.array([500_000.0, 5_200_000.0, 300.0])
    local = np.array([[0.1, 0.2, 0.3], [0.4, -0.2, 0.1], [-0.3, 0.25, 0.7]])
    vertices = "".join(f"v {x} {y} {z}\n" for x, y, z in center + local)
    (tmp_path / "mesh.obj").write_text(vertices + "f 1 2 3\n")
    mesh = read_mesh(tmp_path / "mesh.obj", Normalization(1.0, tuple(center)))
    assert trimesh.load_mesh(tmp_path / "mesh.obj", process=False).vertices.dtype == np.float64
    np.testing.assert_allclose(mesh.vertices.numpy(), local, atol=1e-6)


def glb_with_buffer(uri: str) -> bytes:
    """A binary glTF file of one triangle, whose numbers are in another file."""
    accessors = [
        {"bufferView": 0, "componentType": 5126, "count": 3, "type": "VEC3", "min": [0] * 3, "max": [1] * 3},
        {"bufferView": 1, "componentType": 5125, "count": 3, "type": "SCALAR"},
    ]
    contents = {
        "asset": {"version": "2.0"},
        "buffers": [{"uri": uri, "byteLength": 48}],
        "bufferViews": [
            {"buffer": 0, "byteOffset": 0, "byteLength": 36},
            {"buffer": 0, "byteOffset": 36, "byteLength": 12},
        ],
        "accessors": accessors,
        "meshes": [{"primitives": [{"attributes": {"POSITION": 0}, "indices": 1}]}],
        "nodes": [{"mesh": 0}],
        "scenes": [{"nodes": [0]}],
        "scene": 0,
    }
    text = json.dumps(contents).encode()
    text += b" " * (-len(text) % 4)
    numbers = [part.to_bytes(4, "little") for part in (2, 20 + len(text), len(text))]
    return b"glTF" + b"".join(numbers) + b"JSON" + text


def test_no_other_file_that_a_mesh_names_is_opened(tmp_path: Path, monkeypatch, caplog) -> None:
    """Materials, textures and buffers: none is needed, and their names may lead out of the capture."""
    opened = []
    monkeypatch.setattr(
        trimesh.resolvers.FilePathResolver, "get", lambda _, name: opened.append(name) or b"newmtl a\n"
    )
    ball = trimesh.creation.icosphere(subdivisions=1)
    text = "mtllib ../a.mtl\nusemtl a\n" + ball.export(file_type="obj")
    (tmp_path / "a.obj").write_text(text)
    data = ball.export(file_type="ply").replace(b"comment", b"comment TextureFile ../a.png\ncomment", 1)
    (tmp_path / "a.ply").write_bytes(data)
    (tmp_path / "a.glb").write_bytes(glb_with_buffer("a.bin"))
    with caplog.at_level(logging.WARNING):
        for name in ("a.obj", "a.ply"):
            assert len(read_mesh(tmp_path / name, UNIT).faces) == len(ball.faces)
        assert len(_points(tmp_path / "a.ply")) == len(ball.vertices)
        with pytest.raises(UserError, match=r"a\.glb: not a mesh that can be read"):
            read_mesh(tmp_path / "a.glb", UNIT)
    assert opened == []
    assert caplog.records == []


def test_other_formats_are_refused(tmp_path: Path) -> None:
    """trimesh would unpack an archive to find meshes in it."""
    (tmp_path / "a.zip").write_bytes(b"PK")
    with pytest.raises(UserError, match=r"not a format of meshes that is read; use one of \.ply, \.obj"):
        read_mesh(tmp_path / "a.zip", UNIT)
