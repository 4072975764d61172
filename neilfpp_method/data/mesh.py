"""Triangle meshes of a capture, in the scene frame."""

from __future__ import annotations

import json
import struct
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch
import trimesh
from jaxtyping import Float, Int
from torch import Tensor

from neilfpp_method.data.views import Normalization
from neilfpp_method.errors import UserError

__all__ = ["Mesh", "read_mesh"]

SUFFIXES = (".ply", ".obj", ".stl", ".off", ".glb")
"""Formats that are read, by suffix; trimesh would also unpack archives and run other programs."""


@dataclass(frozen=True)
class Mesh:
    """A triangle mesh in the scene frame."""

    vertices: Float[Tensor, "V 3"]
    faces: Int[Tensor, "F 3"]


def read_mesh(path: Path, normalization: Normalization) -> Mesh:
    """Read a mesh in the world frame and transform it to the scene frame. Equal vertices are not merged.

    Raises:
        UserError: the file does not exist, is of another format than PLY, OBJ, STL, OFF or GLB, or has no
            valid triangles.
    """
    if not path.is_file():
        raise UserError(
            f"{path}: there is no such mesh", "give the path of a triangle mesh, such as a PLY file"
        )
    suffix = path.suffix.lower()
    if suffix not in SUFFIXES:
        raise UserError(f"{path}: not a format of meshes that is read", f"use one of {', '.join(SUFFIXES)}")
    try:
        if suffix == ".glb":
            _check_counts(path)
        # No other file that the mesh names is opened: there is nothing in this archive.
        alone = trimesh.resolvers.ZipResolver({})
        mesh = trimesh.load_mesh(path, resolver=alone, process=False, skip_materials=True)
        # In double precision, because the world's origin may be far away, as in map coordinates.
        vertices = torch.as_tensor(np.array(mesh.vertices), dtype=torch.float64)
        faces = torch.as_tensor(np.array(mesh.faces), dtype=torch.int64)
    except Exception as error:
        # trimesh raises many types of exceptions for damaged files.
        raise UserError(f"{path}: not a mesh that can be read ({error})", "export it again as PLY") from error
    flat = vertices.shape != (len(vertices), 3) or faces.shape != (len(faces), 3)
    if (
        flat
        or not len(faces)
        or not vertices.isfinite().all()
        or faces.min() < 0
        or faces.max() >= len(vertices)
    ):
        raise UserError(
            f"{path}: no triangles, or triangles with vertices that do not exist", "export it again"
        )
    return Mesh(normalization.to_scene(vertices).float(), faces)


def _check_counts(path: Path) -> None:
    """Check the lengths in a binary glTF file, because trimesh allocates memory for them before reading.

    Raises:
        ValueError: the file is shorter than its lengths say.
    """
    size = path.stat().st_size
    with path.open("rb") as file:
        place = 12
        while place + 8 <= size:
            file.seek(place)
            length, kind = struct.unpack("<I4s", file.read(8))
            place += 8 + length
            if place > size:
                raise ValueError("it is shorter than its header states")
            if kind == b"JSON":
                accessors = json.loads(file.read(length)).get("accessors", [])
                if any(accessor["count"] > size for accessor in accessors):
                    raise ValueError("its header states more numbers than it has bytes")
