"""Shapes: point clouds and meshes."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

import numpy as np
import trimesh

from neilfpp_method.data.mesh import read_mesh
from neilfpp_method.data.point_cloud import has_normals, read_oriented_ply, read_positions
from neilfpp_method.data.views import Normalization
from tests.hard_cases.hostile.readers.reader import Reader

__all__ = ["SHAPES"]

UNIT = Normalization(1.0, (0.0, 0.0, 0.0))


def _ply(folder: Path) -> list[Path]:
    points = np.random.default_rng(1).normal(size=(20, 6))
    names = "".join(f"property float {name}\n" for name in ("x", "y", "z", "nx", "ny", "nz"))
    for name, order in (("binary_little_endian", "<f4"), ("binary_big_endian", ">f4")):
        head = f"ply\nformat {name} 1.0\nelement vertex 20\n{names}end_header\n"
        (folder / f"{name}.ply").write_bytes(head.encode() + points.astype(order).tobytes())
    head = f"ply\nformat ascii 1.0\ncomment by hand\nelement vertex 20\n{names}end_header\n"
    rows = "\n".join(" ".join(f"{value:.6g}" for value in row) for row in points)
    (folder / "ascii.ply").write_text(head + rows + "\n")
    return sorted(folder.iterdir())


def _read_ply(folder: Path, damaged: Path) -> None:
    assert np.isfinite(read_positions(damaged)).all()
    has_normals(damaged)
    points = read_oriented_ply(damaged)
    assert np.isfinite(points.position).all()
    assert np.isfinite(points.normal).all()


def _mesh(folder: Path) -> list[Path]:
    ball = trimesh.creation.icosphere(subdivisions=1)
    for name in ("binary.ply", "ball.obj", "ball.stl", "ball.off", "ball.glb"):
        ball.export(folder / name)
    ball.export(folder / "ascii.ply", encoding="ascii")
    return sorted(folder.iterdir())


def _read_mesh(folder: Path, damaged: Path) -> None:
    mesh = read_mesh(damaged, UNIT)
    assert mesh.vertices.isfinite().all()
    assert mesh.faces.amin() >= 0
    assert mesh.faces.amax() < len(mesh.vertices)


SHAPES: Mapping[str, Reader] = {
    "points (PLY)": Reader(_ply, _read_ply),
    "mesh (PLY, OBJ, STL, OFF, GLB)": Reader(_mesh, _read_mesh),
}
