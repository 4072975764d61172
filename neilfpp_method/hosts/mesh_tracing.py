"""First hits of rays with triangles: in plain tensors on the device of the rays, or by Embree on a CPU.

Both answer which triangle a ray meets first; `meet` says where.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
import torch
import trimesh
from jaxtyping import Bool, Float, Int
from torch import Tensor

__all__ = ["BoxTree", "FirstHits", "Meeting", "build_tree", "embree_tracer", "meet", "tree_tracer"]

FirstHits = Callable[[Float[Tensor, "N 3"], Float[Tensor, "N 3"]], Int[Tensor, " N"]]
"""Origins and unit directions → the triangle that each ray meets first, −1 for none."""

BRANCHES = 8
MORTON_BITS = 20
RAYS_AT_ONCE = 8192
"""Bounds the memory: some hundred triangles are tried per ray."""
SLACK = 1e-6
"""In shares of a triangle: rays through an edge that two triangles share must not slip between them."""
MIN_COMPONENT = 1e-12
"""A direction's component is kept off zero by this, so that its inverse is finite."""


@dataclass(frozen=True)
class Meeting:
    """Where rays meet their triangles: the length along the ray, and the weights of the three corners."""

    distance: Float[Tensor, " N"]
    weights: Float[Tensor, "N 3"]


def meet(
    origins: Float[Tensor, "N 3"], directions: Float[Tensor, "N 3"], triangles: Float[Tensor, "N 3 3"]
) -> Meeting:
    """Each ray with the plane of its own triangle (Möller & Trumbore 1997); not finite for a ray along it."""
    corner, first, second = (
        triangles[:, 0],
        triangles[:, 1] - triangles[:, 0],
        triangles[:, 2] - triangles[:, 0],
    )
    across = torch.linalg.cross(directions, second)
    determinant = (first * across).sum(-1)
    offset = origins - corner
    u = (offset * across).sum(-1) / determinant
    turned = torch.linalg.cross(offset, first)
    v = (directions * turned).sum(-1) / determinant
    return Meeting((second * turned).sum(-1) / determinant, torch.stack([1.0 - u - v, u, v], dim=-1))


# -------------------------------------------------------------------------------------------- a tree of boxes


@dataclass(frozen=True)
class Boxes:
    """The lower and the upper corners of K boxes along the axes."""

    low: Float[Tensor, "K 3"]
    high: Float[Tensor, "K 3"]


@dataclass(frozen=True)
class BoxTree:
    """Triangles along a space-filling curve, and boxes around every 8, 64, 512, … of them, the root first.

    Node i of a level holds the nodes 8 i … 8 i + 7 of the next one, and of the last level the triangles.
    Levels are filled up to eights with boxes that are inside out, and the triangles with ones that are not
    finite.
    """

    triangles: Float[Tensor, "P 3 3"]
    numbers: Int[Tensor, " P"]
    levels: tuple[Boxes, ...]


def build_tree(triangles: Float[Tensor, "F 3 3"]) -> BoxTree:
    """Sort triangles by the Morton code of their centres, and box them in eights of eights."""
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
    """First hits by way of the tree, on its device; deterministic."""

    def first_hits(origins: Float[Tensor, "N 3"], directions: Float[Tensor, "N 3"]) -> Int[Tensor, " N"]:
        parts = zip(origins.split(RAYS_AT_ONCE), directions.split(RAYS_AT_ONCE), strict=True)
        return torch.cat([_descend(tree, o, d) for o, d in parts])

    return first_hits


def _descend(
    tree: BoxTree, origins: Float[Tensor, "N 3"], directions: Float[Tensor, "N 3"]
) -> Int[Tensor, " N"]:
    """All rays go down the tree together: a level takes pairs (ray, node) and leaves those that meet."""
    count, device = len(origins), origins.device
    inverse = 1.0 / torch.where(
        directions < 0.0, directions.clamp_max(-MIN_COMPONENT), directions.clamp_min(MIN_COMPONENT)
    )
    rays = torch.arange(count, device=device)
    nodes = torch.zeros_like(rays)
    children = torch.arange(BRANCHES, device=device)
    for boxes in tree.levels:
        kept = torch.nonzero(_meets_box(origins[rays], inverse[rays], boxes.low[nodes], boxes.high[nodes]))[
            :, 0
        ]
        rays = rays[kept].repeat_interleave(BRANCHES)
        nodes = (BRANCHES * nodes[kept][:, None] + children).reshape(-1)
    meeting = meet(origins[rays], directions[rays], tree.triangles[nodes])
    inside = (meeting.weights >= -SLACK).all(-1) & (meeting.distance > 0.0)
    distance = torch.where(inside, meeting.distance, torch.inf)
    nearest = distance.new_full((count,), torch.inf).scatter_reduce(0, rays, distance, "amin")
    # Of triangles at the same distance along a ray, the last in the mesh: the same in every run.
    winner = torch.where(inside & (distance == nearest[rays]), tree.numbers[nodes], -1)
    return torch.full_like(nearest, -1, dtype=torch.int64).scatter_reduce(0, rays, winner, "amax")


def _meets_box(
    origins: Float[Tensor, "K 3"],
    inverse: Float[Tensor, "K 3"],
    low: Float[Tensor, "K 3"],
    high: Float[Tensor, "K 3"],
) -> Bool[Tensor, " K"]:
    """Whether rays pass through boxes. The direction chooses the sides, so an inverted box is never met."""
    forward = inverse > 0.0
    enter = ((torch.where(forward, low, high) - origins) * inverse).amax(-1)
    leave = ((torch.where(forward, high, low) - origins) * inverse).amin(-1)
    return (enter <= leave) & (leave >= 0.0)


def _fill_up(rows: Tensor, value: float | int) -> Tensor:
    """The rows, and as many of a constant value as a multiple of 8 needs."""
    missing = -len(rows) % BRANCHES
    return torch.cat([rows, rows.new_full((missing, *rows.shape[1:]), value)])


def _morton(points: Float[Tensor, "F 3"]) -> Int[Tensor, " F"]:
    """Interleaved bits of the coordinates: points that are close on the curve are close in space."""
    low, high = points.amin(dim=0), points.amax(dim=0)
    cells = ((points - low) / (high - low).amax().clamp_min(MIN_COMPONENT) * (2**MORTON_BITS - 1)).long()
    code = torch.zeros_like(cells[:, 0])
    for bit in range(MORTON_BITS):
        for axis in range(3):
            code |= ((cells[:, axis] >> bit) & 1) << (3 * bit + axis)
    return code


# ----------------------------------------------------------------------------------------------------- Embree


def embree_tracer(triangles: Float[Tensor, "F 3 3"]) -> FirstHits | None:
    """First hits by Embree, for rays on a CPU; none where Embree is not installed."""
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
