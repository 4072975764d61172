"""What of a surface is worth keeping: what cameras saw, without crumbs, and without small holes."""

from __future__ import annotations

import numpy as np
import trimesh
from jaxtyping import Bool, Int

from neilfpp_method.errors import UserError
from neilfpp_method.export.asset.surface import Surface, creased

__all__ = ["HOLE", "clean", "close_holes", "keep_seen", "without_crumbs"]

HOLE = 0.05
"""Scene units: holes of this size and smaller are closed, and unseen patches of this size stay."""
CRUMB = 0.002
"""A component with a smaller share of the largest one's area is left out."""


def clean(surface: Surface, seen: Bool[np.ndarray, " F"]) -> Surface:
    """The part that was seen, without crumbs, its small holes closed.

    Raises:
        UserError: nothing was seen.
    """
    if not seen.any():
        raise UserError(
            "no training camera sees the surface", "train the run for longer, and look at its previews"
        )
    return close_holes(without_crumbs(keep_seen(surface, seen)))


def keep_seen(surface: Surface, seen: Bool[np.ndarray, " F"]) -> Surface:
    """What was seen, a ring of triangles around it, and unseen patches that are too small to be holes."""
    touched = np.zeros(len(surface.vertices), dtype=bool)
    touched[surface.faces[seen]] = True
    kept = touched[surface.faces].any(axis=1)
    left = np.flatnonzero(~kept)
    component = _components(surface.part(left))
    for number in np.unique(component):
        patch = left[component == number]
        if _width(surface, surface.faces[patch]) <= HOLE:
            kept[patch] = True
    return surface.part(kept)


def without_crumbs(surface: Surface) -> Surface:
    """The components that are not much smaller than the largest one."""
    component = _components(surface)
    area = np.bincount(component, surface.mesh().area_faces)
    return surface.part((area >= CRUMB * area.max())[component])


def close_holes(surface: Surface) -> Surface:
    """Borders of up to `HOLE` get a fan of triangles about their middle, wound as their neighbours."""
    vertices, fans = [surface.vertices], []
    count = len(surface.vertices)
    for loop in _borders(surface):
        if np.ptp(surface.vertices[loop], axis=0).max() > HOLE:
            continue
        # A border runs as its triangles do, so the fan runs against it.
        fans.append(np.stack([np.roll(loop, -1), loop, np.full(len(loop), count)], axis=1))
        vertices.append(surface.vertices[loop].mean(axis=0, keepdims=True))
        count += 1
    if not fans:
        return surface
    fan = creased(np.concatenate(vertices), np.concatenate(fans))
    faces = np.concatenate([surface.faces, fan.faces])
    return Surface(fan.vertices, faces, np.concatenate([surface.normals, fan.normals]))


def _components(surface: Surface) -> Int[np.ndarray, " F"]:
    """A number for each triangle: the same for those that are joined by edges."""
    if not len(surface.faces):
        return np.zeros(0, dtype=np.int64)
    adjacency, count = surface.mesh().face_adjacency, len(surface.faces)
    labels = trimesh.graph.connected_component_labels(adjacency, node_count=count)
    return np.asarray(labels).astype(np.int64)


def _width(surface: Surface, faces: Int[np.ndarray, "K 3"]) -> float:
    return float(np.ptp(surface.vertices[faces].reshape(-1, 3), axis=0).max())


def _borders(surface: Surface) -> list[Int[np.ndarray, " L"]]:
    """Closed loops of edges that belong to one triangle each, in the direction of that triangle. A vertex at
    which two loops touch ends the walk; such loops stay open."""
    edges = np.concatenate([surface.faces[:, [0, 1]], surface.faces[:, [1, 2]], surface.faces[:, [2, 0]]])
    number = np.sort(edges, axis=1) @ np.array([len(surface.vertices), 1])
    _, index, times = np.unique(number, return_index=True, return_counts=True)
    starts, ends = edges[index[times == 1]].T
    once = np.bincount(starts, minlength=len(surface.vertices)) == 1
    after = {int(a): int(b) for a, b in zip(starts, ends, strict=True) if once[a]}
    loops = []
    while after:
        first, place = after.popitem()
        loop = [first]
        while place != first and place in after:
            loop.append(place)
            place = after.pop(place)
        if place == first:
            loops.append(np.array(loop))
    return loops
