"""The surface of a run in a compact format for the viewer of the report, with material at its vertices."""

from __future__ import annotations

import base64
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
import trimesh
from jaxtyping import Float

from neilfpp_method.export.asset.clean import clean
from neilfpp_method.export.asset.simplify import decimated
from neilfpp_method.export.asset.surface import AssetSurface, fine_surface
from neilfpp_method.export.asset.visible import visible_faces
from neilfpp_method.export.mesh import materials_in_parts
from neilfpp_method.shading.color import tone_map
from neilfpp_method.train.run import Run

__all__ = ["FACES", "packed_surface"]

FACES = 80_000
"""Target number of triangles, which take about 2 MB in the page. A finer surface is simplified. A much
coarser one is subdivided, because the material is stored at vertices.
"""
EDGE_SLACK = 1.5
"""Longest edge after subdivision, relative to the edge of an equilateral triangle of the mean area."""
RESOLUTION = 192
"""Number of cells along an edge of the scene's cube when a surface is extracted from a distance field."""


@torch.no_grad()
def packed_surface(run: Run) -> dict[str, Any]:
    """Pack the surface into the format that `viewer.js` reads.

    Returns:
        Counts, the bounding box, and arrays as little-endian bytes in base64::

            position   uint16 (V, 3), 0 … 65535 across the box from `low` to `high`, scene frame
            normal     int8 (V, 3), 127 is 1
            color      uint8 (V, 3), base colour, sRGB; absent without a material
            material   uint8 (V, 2), roughness and metallic; absent without a material
            index      uint32 (F, 3)

    Raises:
        UserError: the run has no surface, or no camera sees it.
    """
    full = fine_surface(run, RESOLUTION)
    cameras = [run.capture.scene_camera(view) for view in run.capture.train_views]
    surface = clean(full, visible_faces(full, cameras))
    if len(surface.faces) > FACES:
        surface = decimated(surface, FACES)
    corners = _corners(surface)
    low, high = corners.position.min(0), corners.position.max(0)
    extent = np.maximum(high - low, 1e-9)
    position = np.rint((corners.position - low) / extent * 65535).astype(np.uint16)
    # Corners that are equal after rounding become one vertex. To compare whole rows, normals take the type of
    # the positions for a moment, bit by bit.
    normal = np.rint(corners.normal * 127).astype(np.int16)
    rows, index = np.unique(
        np.concatenate([position, normal.view(np.uint16)], 1), axis=0, return_inverse=True
    )
    position, normal = np.ascontiguousarray(rows[:, :3]), rows[:, 3:].copy().view(np.int16).astype(np.int8)
    packed: dict[str, Any] = {
        "vertices": len(rows),
        "faces": len(index) // 3,
        "low": low.tolist(),
        "high": (low + extent).tolist(),
        "position": _base64(position),
        "normal": _base64(normal),
        "index": _base64(index.astype(np.uint32)),
    }
    if run.has_material:
        points = torch.from_numpy(low + position / 65535 * extent).float()
        material = materials_in_parts(run, points.to(run.device))
        roughness_metallic = torch.cat([material.roughness, material.metallic], -1)
        packed["color"] = _base64(_bytes(tone_map(material.base_color)))
        packed["material"] = _base64(_bytes(roughness_metallic))
    return packed


@dataclass(frozen=True)
class _Corners:
    """The C corners of C / 3 triangles: positions and unit normals, scene frame."""

    position: Float[np.ndarray, "C 3"]
    normal: Float[np.ndarray, "C 3"]


def _corners(surface: AssetSurface) -> _Corners:
    """The corners of all triangles; large triangles are subdivided first."""
    if len(surface.faces) > FACES / 2:
        return _Corners(surface.vertices[surface.faces].reshape(-1, 3), surface.normals.reshape(-1, 3))
    # An equilateral triangle of area A has edges of length 2 √(A / √3).
    edge = EDGE_SLACK * 2 * np.sqrt(surface.mesh().area / FACES / np.sqrt(3))
    vertices, faces, source = trimesh.remesh.subdivide_to_size(
        surface.vertices, surface.faces, edge, max_iter=12, return_index=True
    )
    corners = vertices[faces].reshape(-1, 3)
    source = np.repeat(source, 3)
    weights = trimesh.triangles.points_to_barycentric(surface.vertices[surface.faces[source]], corners)
    normals = (np.nan_to_num(weights)[..., None] * surface.normals[source]).sum(1)
    return _Corners(corners, normals / np.maximum(np.linalg.norm(normals, axis=-1, keepdims=True), 1e-9))


def _bytes(values: torch.Tensor) -> np.ndarray:
    return (values.clamp(0, 1) * 255).round().byte().cpu().numpy()


def _base64(values: np.ndarray) -> str:
    little_endian = np.ascontiguousarray(values, values.dtype.newbyteorder("<"))
    return base64.b64encode(little_endian.tobytes()).decode("ascii")
