"""First hits of rays with triangles: by tensor operations on the device of the rays, or by Embree on a CPU.

Both return the triangle that each ray hits first; `intersect_planes` computes where.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
import torch
import trimesh
from jaxtyping import Bool, Float, Int
from torch import Tensor

from neilfpp_method.shading.frame import safe_normalize

__all__ = [
    "TINY",
    "BoxTree",
    "FirstHits",
    "PlaneHits",
    "build_tree",
    "embree_tracer",
    "face_normals",
    "first_hits_of",
    "intersect_planes",
    "normals_towards_viewer",
    "tree_tracer",
]

FirstHits = Callable[[Float[Tensor, "N 3"], Float[Tensor, "N 3"]], Int[Tensor, " N"]]
"""Maps origins and unit directions to the index of the triangle that each ray hits first, −1 for a miss."""

TINY = 1e-18
"""Length below which a cross product of edges has no direction; tiny, because triangles may be small."""
BRANCHES = 8
"""Children per node of the tree."""
MORTON_BITS = 20
"""Bits per coordinate of Morton codes: three times as many fit into 64 bits."""
RAYS_AT_ONCE = 8192
"""Rays per batch; limits memory, as about a hundred triangles are tested per ray."""
SLACK = 1e-6
"""Tolerance of barycentric coordinates, and of boxes relative to the scene, so that rays through an edge that
two triangles share do not pass between them.
"""
MIN_COMPONENT = 1e-12
"""Lower bound on the size of a direction's components, so that their inverses are finite."""


def first_hits_of(triangles: Float[Tensor, "F 3 3"]) -> FirstHits:
    """Make a tracer on the device of the triangles: Embree on a CPU if it is installed, else a tree."""
    embree = embree_tracer(triangles) if triangles.device.type == "cpu" else None
    return embree or tree_tracer(build_tree(triangles))


def face_normals(triangles: Float[Tensor, "F 3 3"]) -> Float[Tensor, "F 3"]:
    """Unit normals of triangles, on the side from which their corners run counter-clockwise."""
    across = torch.linalg.cross(triangles[:, 1] - triangles[:, 0], triangles[:, 2] - triangles[:, 0])
    return safe_normalize(across, eps=TINY)


def normals_towards_viewer(
    smooth: Float[Tensor, "N 3"], flat: Float[Tensor, "N 3"], directions: Float[Tensor, "N 3"]
) -> Float[Tensor, "N 3"]:
    """Shading normals at hits of rays: the interpolated normal, or that of the triangle at grazing angles, at
    which the interpolated normal can face away from the viewer.
    """
    faces_viewer = (smooth * directions).sum(-1, keepdim=True) < 0
    return torch.where(faces_viewer, smooth, flat)


@dataclass(frozen=True)
class PlaneHits:
    """Intersections of rays with the planes of triangles: distance along the ray, and barycentric weights of
    the corners, which are negative outside of the triangle.
    """

    distance: Float[Tensor, " N"]
    weights: Float[Tensor, "N 3"]


def intersect_planes(
    origins: Float[Tensor, "N 3"], directions: Float[Tensor, "N 3"], triangles: Float[Tensor, "N 3 3"]
) -> PlaneHits:
    """Intersect each ray with the plane of its triangle (Möller & Trumbore 1997).

    The result is not finite for a ray parallel to the plane.
    """
    corner = triangles[:, 0]
    first, second = triangles[:, 1] - corner, triangles[:, 2] - corner
    across = torch.linalg.cross(directions, second)
    determinant = (first * across).sum(-1)
    offset = origins - corner
    u = (offset * across).sum(-1) / determinant
    turned = torch.linalg.cross(offset, first)
    v = (directions * turned).sum(-1) / determinant
    return PlaneHits((second * turned).sum(-1) / determinant, torch.stack([1.0 - u - v, u, v], dim=-1))


# -------------------------------------------------------------------------------------------- a tree of boxes


@dataclass(frozen=True)
class Boxes:
    """The lower and upper corners of K axis-aligned boxes."""

    low: Float[Tensor, "K 3"]
    high: Float[Tensor, "K 3"]


@dataclass(frozen=True)
class BoxTree:
    """Triangles sorted along a space-filling curve, and boxes around every 8, 64, 512, … of them, root first.

    Node i of a level contains the nodes 8 i … 8 i + 7 of the next level, or these triangles on the last
    level. Levels are padded to multiples of 8 with empty (inverted) boxes, and triangles with NaN.
    """

    triangles: Float[Tensor, "P 3 3"]
    numbers: Int[Tensor, " P"]
    levels: tuple[Boxes, ...]


def build_tree(triangles: Float[Tensor, "F 3 3"]) -> BoxTree:
    """Build a tree: sort triangles by the Morton codes of their centroids, and bound groups of 8."""
    order = torch.argsort(_morton(triangles.mean(dim=1)), stable=True)
    padded = _fill_up(triangles[order], torch.nan)
    numbers = _fill_up(order, -1)
    room = SLACK * triangles.abs().max()
    low, high = triangles[order].amin(dim=1) - room, triangles[order].amax(dim=1) + room
    levels: list[Boxes] = []
    while not levels or len(low) > 1:
        low = _fill_up(low, torch.inf).reshape(-1, BRANCHES, 3).amin(dim=1)
        high = _fill_up(high, -torch.inf).reshape(-1, BRANCHES, 3).amax(dim=1)
        levels.insert(0, Boxes(_fill_up(low, torch.inf), _fill_up(high, -torch.inf)))
    return BoxTree(padded, numbers, tuple(levels))


def tree_tracer(tree: BoxTree) -> FirstHits:
    """Make a deterministic tracer that uses a tree, on its device."""

    def first_hits(origins: Float[Tensor, "N 3"], directions: Float[Tensor, "N 3"]) -> Int[Tensor, " N"]:
        parts = zip(origins.split(RAYS_AT_ONCE), directions.split(RAYS_AT_ONCE), strict=True)
        return torch.cat([_descend(tree, o, d) for o, d in parts])

    return first_hits


def _descend(
    tree: BoxTree, origins: Float[Tensor, "N 3"], directions: Float[Tensor, "N 3"]
) -> Int[Tensor, " N"]:
    """Descend the tree with all rays together: each level keeps the pairs (ray, node) that intersect."""
    count, device = len(origins), origins.device
    inverse = 1.0 / torch.where(
        directions < 0.0, directions.clamp_max(-MIN_COMPONENT), directions.clamp_min(MIN_COMPONENT)
    )
    rays = torch.arange(count, device=device)
    nodes = torch.zeros_like(rays)
    children = torch.arange(BRANCHES, device=device)
    for boxes in tree.levels:
        met = _meets_box(origins[rays], inverse[rays], boxes.low[nodes], boxes.high[nodes])
        kept = torch.nonzero(met)[:, 0]
        rays = rays[kept].repeat_interleave(BRANCHES)
        nodes = (BRANCHES * nodes[kept][:, None] + children).reshape(-1)
    hits = intersect_planes(origins[rays], directions[rays], tree.triangles[nodes])
    inside = (hits.weights >= -SLACK).all(-1) & (hits.distance > 0.0)
    distance = torch.where(inside, hits.distance, torch.inf)
    nearest = distance.new_full((count,), torch.inf).scatter_reduce(0, rays, distance, "amin")
    # Of several triangles at the same distance take the one with the largest index, in every run.
    winner = torch.where(inside & (distance == nearest[rays]), tree.numbers[nodes], -1)
    return torch.full_like(nearest, -1, dtype=torch.int64).scatter_reduce(0, rays, winner, "amax")


def _meets_box(
    origins: Float[Tensor, "K 3"],
    inverse: Float[Tensor, "K 3"],
    low: Float[Tensor, "K 3"],
    high: Float[Tensor, "K 3"],
) -> Bool[Tensor, " K"]:
    """Whether rays intersect boxes. Sides are chosen by the direction, so inverted boxes never intersect."""
    forward = inverse > 0.0
    enter = ((torch.where(forward, low, high) - origins) * inverse).amax(-1)
    leave = ((torch.where(forward, high, low) - origins) * inverse).amin(-1)
    return (enter <= leave) & (leave >= 0.0)


def _fill_up(rows: Tensor, value: float | int) -> Tensor:
    """Pad rows with a constant to a multiple of 8."""
    missing = -len(rows) % BRANCHES
    return torch.cat([rows, rows.new_full((missing, *rows.shape[1:]), value)])


def _morton(points: Float[Tensor, "F 3"]) -> Int[Tensor, " F"]:
    """Morton codes: interleaved bits of the coordinates. Points with close codes are close in space."""
    low, high = points.amin(dim=0), points.amax(dim=0)
    cells = ((points - low) / (high - low).amax().clamp_min(MIN_COMPONENT) * (2**MORTON_BITS - 1)).long()
    code = torch.zeros_like(cells[:, 0])
    for bit in range(MORTON_BITS):
        for axis in range(3):
            code |= ((cells[:, axis] >> bit) & 1) << (3 * bit + axis)
    return code


# ----------------------------------------------------------------------------------------------------- Embree


def embree_tracer(triangles: Float[Tensor, "F 3 3"]) -> FirstHits | None:
    """Make a tracer that uses Embree, for rays on a CPU; None if Embree is not installed."""
    try:
        from trimesh.ray.ray_pyembree import RayMeshIntersector
    except ImportError:
        return None
    corners = triangles.reshape(-1, 3).cpu().numpy()
    faces = np.arange(len(corners)).reshape(-1, 3)
    tracer = RayMeshIntersector(trimesh.Trimesh(corners, faces, process=False))

    def first_hits(origins: Float[Tensor, "N 3"], directions: Float[Tensor, "N 3"]) -> Int[Tensor, " N"]:
        if not len(origins):
            return torch.zeros(0, dtype=torch.int64)
        return torch.from_numpy(tracer.intersects_first(origins.numpy(), directions.numpy()).astype(np.int64))

    return first_hits
