"""The surface of a run for the viewer in its page: few bytes, with the material at its vertices."""

from __future__ import annotations

import base64
from typing import Any

import fast_simplification
import numpy as np
import torch
import trimesh

from neilfpp_method.export.asset.clean import clean
from neilfpp_method.export.asset.surface import Surface, creased, fine_surface
from neilfpp_method.export.asset.visible import seen_faces
from neilfpp_method.export.mesh import materials_in_parts
from neilfpp_method.shading.color import tone_map
from neilfpp_method.train.run import Run

__all__ = ["FACES", "packed_surface"]

FACES = 80_000
"""Triangles: more are simplified, far fewer divided, as vertices hold colours. 2 MB in the page."""
RESOLUTION = 192
"""Cells along an edge of the scene's cube, where the surface is that of a distance field."""


@torch.no_grad()
def packed_surface(run: Run) -> dict[str, Any]:
    """What `viewer.js` reads: counts, the box, and arrays in base64, little end first.

    position   uint16 (V, 3), 0 … 65535 across the box from `low` to `high`, scene frame
    normal     int8 (V, 3), 127 is 1
    color      uint8 (V, 3), base colour, sRGB, absent without a material
    material   uint8 (V, 2), roughness and metallic, absent without a material
    index      uint32 (F, 3)

    Raises:
        UserError: the run has no surface, or no camera sees it.
    """
    whole = fine_surface(run, RESOLUTION)
    cameras = [run.capture.normalisation.camera(view.camera) for view in run.capture.train_views]
    surface = clean(whole, seen_faces(whole, cameras))
    if len(surface.faces) > FACES:
        points, faces = fast_simplification.simplify(
            surface.vertices.astype(np.float32), surface.faces.astype(np.int32), target_count=FACES
        )
        surface = creased(np.asarray(points, np.float64), np.asarray(faces))
    corners, normals = _corners(surface)
    low, high = corners.min(0), corners.max(0)
    extent = np.maximum(high - low, 1e-9)
    position = np.rint((corners - low) / extent * 65535).astype(np.uint16)
    turned = np.rint(normals * 127).astype(np.int16)
    rows, index = np.unique(
        np.concatenate([position, turned.view(np.uint16)], 1), axis=0, return_inverse=True
    )
    position, normal = np.ascontiguousarray(rows[:, :3]), rows[:, 3:].copy().view(np.int16).astype(np.int8)
    packed: dict[str, Any] = {
        "vertices": len(rows),
        "faces": len(index) // 3,
        "low": low.tolist(),
        "high": (low + extent).tolist(),
        "position": _text(position),
        "normal": _text(normal),
        "index": _text(index.astype(np.uint32)),
    }
    if run.has_material:
        device = next(run.model.parameters()).device
        material = materials_in_parts(
            run, torch.from_numpy(low + position / 65535 * extent).float().to(device)
        )
        both = torch.cat([material.roughness, material.metallic], -1)
        packed["color"] = _text(_bytes(tone_map(material.base_color)))
        packed["material"] = _text(_bytes(both))
    return packed


def _corners(surface: Surface) -> tuple[np.ndarray, np.ndarray]:
    """Places and normals of the corners of all triangles; large triangles are divided."""
    area = surface.mesh().area
    edge = 2 * np.sqrt(area / FACES / np.sqrt(3)) * 1.5
    if len(surface.faces) > FACES / 2:
        return surface.vertices[surface.faces].reshape(-1, 3), surface.normals.reshape(-1, 3)
    vertices, faces, source = trimesh.remesh.subdivide_to_size(
        surface.vertices, surface.faces, edge, max_iter=12, return_index=True
    )
    corners = vertices[faces].reshape(-1, 3)
    source = np.repeat(source, 3)
    weights = trimesh.triangles.points_to_barycentric(surface.vertices[surface.faces[source]], corners)
    normals = (np.nan_to_num(weights)[..., None] * surface.normals[source]).sum(1)
    return corners, normals / np.maximum(np.linalg.norm(normals, axis=-1, keepdims=True), 1e-9)


def _bytes(values: torch.Tensor) -> np.ndarray:
    return (values.clamp(0, 1) * 255).round().byte().cpu().numpy()


def _text(values: np.ndarray) -> str:
    return base64.b64encode(np.ascontiguousarray(values, values.dtype.newbyteorder("<")).tobytes()).decode(
        "ascii"
    )
