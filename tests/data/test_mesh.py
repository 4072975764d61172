"""Meshes: vertices in the scene frame."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import trimesh

from neilfpp_method.data.mesh import read_mesh
from neilfpp_method.data.views import Normalization


def test_vertices_far_from_the_origin_keep_their_precision(tmp_path: Path) -> None:
    """Map coordinates: at 5 200 000 m, single precision rounds to 0.5 m."""
    center = np.array([500_000.0, 5_200_000.0, 300.0])
    local = np.array([[0.1, 0.2, 0.3], [0.4, -0.2, 0.1], [-0.3, 0.25, 0.7]])
    vertices = "".join(f"v {x} {y} {z}\n" for x, y, z in center + local)
    (tmp_path / "mesh.obj").write_text(vertices + "f 1 2 3\n")
    mesh = read_mesh(tmp_path / "mesh.obj", Normalization(1.0, tuple(center)))
    assert trimesh.load_mesh(tmp_path / "mesh.obj", process=False).vertices.dtype == np.float64
    np.testing.assert_allclose(mesh.vertices.numpy(), local, atol=1e-6)
