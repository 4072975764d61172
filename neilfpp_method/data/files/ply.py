"""Write binary PLY files, in double precision if single precision would move points."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

import numpy as np
from jaxtyping import Float, Int, Shaped

from neilfpp_method.data.files.atomic_file import replacing

__all__ = ["CODES_BY_NAME", "NORMAL", "POSITION", "needs_double", "write_ply"]

OLD_NAMES = ("char", "uchar", "short", "ushort", "int", "uint", "float", "double")
NEW_NAMES = ("int8", "uint8", "int16", "uint16", "int32", "uint32", "float32", "float64")
CODES = ("i1", "u1", "i2", "u2", "i4", "u4", "f4", "f8")
CODES_BY_NAME = dict(zip(OLD_NAMES + NEW_NAMES, CODES + CODES, strict=True))
"""NumPy's codes of the types that a PLY header names."""
NAMES_BY_CODE = dict(zip(CODES, OLD_NAMES, strict=True))
POSITION = ("x", "y", "z")
"""Names of the coordinates of a vertex."""
NORMAL = ("nx", "ny", "nz")
"""Names of the coordinates of a vertex normal."""
ROUNDING = 1e-6
"""Largest rounding error of a written position, as a share of the longest edge of the bounding box."""


def write_ply(
    path: Path,
    position: Float[np.ndarray, "N 3"],
    columns: Mapping[str, Shaped[np.ndarray, " N"]],
    faces: Int[np.ndarray, "F 3"] | None = None,
) -> Path:
    """Write vertices, and faces if there are any, as binary PLY.

    Positions are written in single precision, except if rounding would move a vertex by more than `ROUNDING`
    of the extent of all vertices, as in map coordinates.

    Args:
        path: the file; it is replaced when it is complete.
        position: positions of the vertices.
        columns: further properties of the vertices by name, of the types that they are written in.
        faces: indices of the vertices of the triangles.

    Returns:
        The path.
    """
    kind = "<f8" if needs_double(position) else "<f4"
    properties = {
        name: column.astype(kind) for name, column in zip(POSITION, position.T, strict=True)
    } | columns
    header = ["ply", "format binary_little_endian 1.0", f"element vertex {len(position)}"]
    vertices = np.empty(len(position), [(name, column.dtype) for name, column in properties.items()])
    for name, column in properties.items():
        header.append(f"property {NAMES_BY_CODE[column.dtype.str[1:]]} {name}")
        vertices[name] = column
    body = vertices.tobytes()
    if faces is not None:
        header += [f"element face {len(faces)}", "property list uchar int vertex_indices"]
        triangles = np.empty(len(faces), [("count", "u1"), ("vertices", "<i4", 3)])
        triangles["count"], triangles["vertices"] = 3, faces
        body += triangles.tobytes()
    with replacing(path) as temporary:
        temporary.write_bytes("\n".join([*header, "end_header\n"]).encode("ascii") + body)
    return path


def needs_double(position: Float[np.ndarray, "N 3"]) -> bool:
    """Whether single precision would move a position by more than `ROUNDING` of the extent of all."""
    if not len(position):
        return False
    moved = np.abs(position.astype(np.float32) - position).max()
    return bool(moved > ROUNDING * np.ptp(position, axis=0).max())
