"""Read and write oriented point clouds: ASCII or binary PLY files whose vertices have normals."""

from __future__ import annotations

import io
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch
from jaxtyping import Float64

from neilfpp_method.data.files.ply import CODES_BY_NAME, NORMAL, POSITION, write_ply
from neilfpp_method.data.views import Normalization
from neilfpp_method.errors import UserError
from neilfpp_method.structures import OrientedPoints

__all__ = [
    "WorldPoints",
    "has_normals",
    "load_point_cloud",
    "read_oriented_ply",
    "read_positions",
    "write_oriented_ply",
]

BYTE_ORDER = {"binary_little_endian": "<", "binary_big_endian": ">", "ascii": None}
"""NumPy's sign of the byte order, by the encoding that a header states."""
HEADER_LIMIT = 65_536
"""Largest number of bytes of the header of a PLY file."""


@dataclass(frozen=True)
class WorldPoints:
    """Positions and normals as the file stores them: in the world frame, with normals of any length."""

    position: Float64[np.ndarray, "N 3"]
    normal: Float64[np.ndarray, "N 3"]


def load_point_cloud(path: Path, normalization: Normalization) -> OrientedPoints:
    """Read an oriented point cloud and transform it to the scene frame, with unit normals.

    Raises:
        UserError: as in `read_oriented_ply`.
    """
    points = read_oriented_ply(path)
    position = normalization.to_scene(torch.from_numpy(points.position))
    normal = torch.nn.functional.normalize(torch.from_numpy(points.normal), dim=-1)
    return OrientedPoints(position.float(), normal.float())


def read_oriented_ply(path: Path) -> WorldPoints:
    """Read positions and normals of the vertices of a PLY file.

    Raises:
        UserError: the file is missing, malformed or cut off, has no points or no normals, or contains a
            number that is not finite or a normal of length 0.
    """
    vertices = _read(path)
    position, normal = _columns(path, vertices, POSITION), _columns(path, vertices, NORMAL)
    if not len(position):
        raise UserError(f"{path}: no points", "export the point cloud again")
    broken = ~(np.isfinite(position) & np.isfinite(normal)).all(axis=1) | (np.abs(normal).max(axis=1) < 1e-6)
    if broken.any():
        raise UserError(
            f"{path}: {broken.sum()} of {len(broken)} points are not finite or have a normal of length 0",
            "remove these points",
        )
    return WorldPoints(position, normal)


def read_positions(path: Path) -> Float64[np.ndarray, "N 3"]:
    """Read the finite positions of the vertices of a PLY file, in the world frame.

    Raises:
        UserError: the file is missing, malformed or cut off.
    """
    position = _columns(path, _read(path), POSITION)
    return position[np.isfinite(position).all(axis=1)]


def has_normals(path: Path) -> bool:
    """Return whether the vertices of a PLY file have normals.

    Raises:
        UserError: as in `read_positions`.
    """
    return set(NORMAL) <= set(_read(path).dtype.names)


def write_oriented_ply(path: Path, points: WorldPoints) -> Path:
    """Write points as binary PLY.

    Normals are in single precision, and positions in the precision that `write_ply` chooses.

    Returns:
        The path.
    """
    normals = dict(zip(NORMAL, points.normal.astype("<f4").T, strict=True))
    return write_ply(path, points.position, normals)


def _read(path: Path) -> np.ndarray:
    try:
        return _vertices(path.read_bytes())
    except (OSError, ValueError, KeyError, IndexError) as error:
        raise UserError(
            f"{path}: not a PLY file that can be read ({error})", "export the point cloud again"
        ) from error


def _columns(path: Path, vertices: np.ndarray, names: tuple[str, str, str]) -> Float64[np.ndarray, "N 3"]:
    for name in names:
        if name not in vertices.dtype.names:
            raise UserError(f"{path}: the points have no {name}", "export them with positions and normals")
    return np.stack([vertices[name].astype(np.float64) for name in names], axis=1)


def _vertices(data: bytes) -> np.ndarray:
    """Parse the vertices into a structured array.

    They must be the first element, as all common programs write them.

    Raises:
        ValueError, KeyError or IndexError: the file is malformed or cut off.
    """
    head, separator, _ = data[:HEADER_LIMIT].partition(b"end_header")
    if not separator or not head.startswith(b"ply"):
        raise ValueError("it has no PLY header")
    lines = [line.split() for line in head.decode("ascii").splitlines() if line.split()]
    encoding = next((words[1] for words in lines if words[0] == "format"), "")
    if encoding not in BYTE_ORDER:
        raise ValueError(f"its header states no format out of {', '.join(BYTE_ORDER)}")
    order = BYTE_ORDER[encoding]
    elements = [i for i, words in enumerate(lines) if words[0] == "element"]
    if not elements or lines[elements[0]][1] != "vertex":
        raise ValueError("its first element is not the vertices")
    count = int(lines[elements[0]][2])
    if count < 0:
        raise ValueError("its header states a negative number of points")
    if count > len(data):
        raise ValueError(f"its header states {count} points, but it has {len(data)} bytes")
    own = lines[elements[0] : elements[1] if len(elements) > 1 else None]
    properties = [(words[2], CODES_BY_NAME[words[1]]) for words in own if words[0] == "property"]
    body = data.index(b"\n", len(head)) + 1
    if order is None:
        text = io.StringIO(data[body:].decode("ascii"))
        rows = (
            np.loadtxt(text, dtype=np.float64, max_rows=count, ndmin=2)
            if count
            else np.empty((0, len(properties)))
        )
        if rows.shape != (count, len(properties)):
            raise ValueError(
                f"its header states {count} points with {len(properties)} numbers each, but they are missing"
            )
        return np.rec.fromarrays(rows.T, names=[name for name, _ in properties])
    return np.frombuffer(data, np.dtype([(name, order + kind) for name, kind in properties]), count, body)
