"""Clean a surface: keep what cameras see, remove small components, and close small holes."""

from __future__ import annotations

import numpy as np
import trimesh
from jaxtyping import Bool, Int

from neilfpp_method.errors import UserError
from neilfpp_method.export.asset.surface import AssetSurface, creased

__all__ = ["HOLE", "clean", "close_holes", "keep_visible", "remove_small_components"]

HOLE = 0.05
"""Default of the largest extent, scene units, of holes that are closed, and of invisible patches that are
kept.
"""
MIN_COMPONENT = 0.002
"""A component whose area is a smaller fraction of that of the largest component is removed."""


def clean(surface: AssetSurface, visible: Bool[np.ndarray, " F"], hole: float = HOLE) -> AssetSurface:
    """Keep the visible part of a surface, remove small components, and close small holes.

    Args:
        surface: the surface.
        visible: triangles that cameras see.
        hole: largest extent, scene units, of holes that are closed, and of invisible patches that are kept.

    Raises:
        UserError: no triangle is visible.
    """
    if not visible.any():
        raise UserError(
            "no training camera sees the surface", "train the run for longer, and check its previews"
        )
    return close_holes(remove_small_components(keep_visible(surface, visible, hole)), hole)


def keep_visible(surface: AssetSurface, visible: Bool[np.ndarray, " F"], hole: float = HOLE) -> AssetSurface:
    """Keep visible triangles, the triangles that touch them, and invisible patches of at most `hole`."""
    on_visible = np.zeros(len(surface.vertices), dtype=bool)
    on_visible[surface.faces[visible]] = True
    kept = on_visible[surface.faces].any(axis=1)
    invisible = np.flatnonzero(~kept)
    component = _components(surface.part(invisible))
    for number in np.unique(component):
        patch = invisible[component == number]
        if _width(surface, surface.faces[patch]) <= hole:
            kept[patch] = True
    return surface.part(kept)


def remove_small_components(surface: AssetSurface) -> AssetSurface:
    """Remove components whose area is below `MIN_COMPONENT` of the largest one's."""
    component = _components(surface)
    area = np.bincount(component, surface.mesh().area_faces)
    return surface.part((area >= MIN_COMPONENT * area.max())[component])


def close_holes(surface: AssetSurface, hole: float = HOLE) -> AssetSurface:
    """Close each border of at most `hole` by a fan of triangles around its centre, oriented consistently."""
    vertices, fans = [surface.vertices], []
    count = len(surface.vertices)
    for loop in _borders(surface):
        if np.ptp(surface.vertices[loop], axis=0).max() > hole:
            continue
        # A border has the orientation of its triangles, so the fan must have the opposite one.
        fans.append(np.stack([np.roll(loop, -1), loop, np.full(len(loop), count)], axis=1))
        vertices.append(surface.vertices[loop].mean(axis=0, keepdims=True))
        count += 1
    if not fans:
        return surface
    fan = creased(np.concatenate(vertices), np.concatenate(fans))
    faces = np.concatenate([surface.faces, fan.faces])
    return AssetSurface(fan.vertices, faces, np.concatenate([surface.normals, fan.normals]))


def _components(surface: AssetSurface) -> Int[np.ndarray, " F"]:
    """Label the triangles by connected component; triangles are connected by shared edges."""
    if not len(surface.faces):
        return np.zeros(0, dtype=np.int64)
    adjacency, count = surface.mesh().face_adjacency, len(surface.faces)
    labels = trimesh.graph.connected_component_labels(adjacency, node_count=count)
    return np.asarray(labels).astype(np.int64)


def _width(surface: AssetSurface, faces: Int[np.ndarray, "K 3"]) -> float:
    """Longest side of the bounding box of some triangles."""
    return float(np.ptp(surface.vertices[faces].reshape(-1, 3), axis=0).max())


def _borders(surface: AssetSurface) -> list[Int[np.ndarray, " L"]]:
    """Closed loops of border edges, in the direction of the triangles that they belong to.

    Loops that touch at a vertex are ambiguous and are left out.
    """
    edges = np.concatenate([surface.faces[:, [0, 1]], surface.faces[:, [1, 2]], surface.faces[:, [2, 0]]])
    edge_id = np.sort(edges, axis=1) @ np.array([len(surface.vertices), 1])
    _, index, count = np.unique(edge_id, return_index=True, return_counts=True)
    starts, ends = edges[index[count == 1]].T
    unique_start = np.bincount(starts, minlength=len(surface.vertices)) == 1
    following = {int(a): int(b) for a, b in zip(starts, ends, strict=True) if unique_start[a]}
    loops = []
    while following:
        first, vertex = following.popitem()
        loop = [first]
        while vertex != first and vertex in following:
            loop.append(vertex)
            vertex = following.pop(vertex)
        if vertex == first:
            loops.append(np.array(loop))
    return loops
