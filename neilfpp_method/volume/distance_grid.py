"""A distance field sampled on a grid, and sphere tracing in it, for cheap visibility.

The grid spans the cube [−radius, radius]³ with vertices on its faces, in the order z, y, x (as
`grid_sample`).
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float
from torch import Tensor
from torch.nn import functional

from neilfpp_method.kernels import ray_tracer

__all__ = [
    "GRID_RESOLUTION",
    "GridHits",
    "SignedDistance",
    "cell_size",
    "look_up",
    "sample_grid",
    "trace_grid",
]

SignedDistance = Callable[[Float[Tensor, "P 3"]], Float[Tensor, " P"]]
"""Signed distance at points of the scene frame, negative inside."""

GRID_RESOLUTION = 128
"""Vertices along an edge of the grid that hard inter-reflection traces. On a recovered table top, visibility
is wrong along 1.03, 0.78, 0.70 and 0.63 % of rays (by cosine) with 96, 128, 160 and 256 vertices.
"""
CHUNK = 65_536
"""Points per evaluation of the field when a grid is sampled; limits memory."""
STEPS = 96
"""Maximum number of steps of a ray. A ray that has not ended by then grazes a surface; it counts as a
miss.
"""
HIT_CELLS = 0.25
"""Distance below which a ray hits, in cells: about the interpolation error."""


def cell_size(grid: Float[Tensor, "R R R"], radius: float) -> float:
    """Edge length of a cell, scene units."""
    return 2 * radius / (grid.shape[0] - 1)


@torch.no_grad()
def sample_grid(sdf: SignedDistance, radius: float, resolution: int, like: Tensor) -> Float[Tensor, "R R R"]:
    """Sample a signed distance field at resolution³ vertices, with the device and dtype of `like`."""
    axis = torch.linspace(-radius, radius, resolution, device=like.device, dtype=like.dtype)
    z, y, x = torch.meshgrid(axis, axis, axis, indexing="ij")
    vertices = torch.stack((x, y, z), -1).reshape(-1, 3)
    return torch.cat([sdf(part) for part in vertices.split(CHUNK)]).reshape(
        resolution, resolution, resolution
    )


def look_up(grid: Float[Tensor, "*C R R R"], radius: float, x: Float[Tensor, "P 3"]) -> Float[Tensor, "*C P"]:
    """Interpolate a grid, or C of them, trilinearly at points; points outside are clamped to the cube."""
    at = (x / radius).view(1, -1, 1, 1, 3)
    grids = grid.reshape(1, -1, *grid.shape[-3:])
    found = functional.grid_sample(grids, at, padding_mode="border", align_corners=True)
    return found.view(*grid.shape[:-3], len(x))


@dataclass(frozen=True)
class GridHits:
    """Distances along rays in scene units, and whether they hit the surface before leaving the cube."""

    distance: Float[Tensor, " P"]
    hit: Bool[Tensor, " P"]


@torch.no_grad()
def trace_grid(
    grid: Float[Tensor, "R R R"],
    radius: float,
    origins: Float[Tensor, "P 3"],
    directions: Float[Tensor, "P 3"],
    *,
    leaves_surface: bool = False,
) -> GridHits:
    """Sphere-trace rays: each step is the interpolated distance, but at least a quarter of a cell.

    Rays from a surface start exactly at their points (`leaves_surface`). If they started above them, along
    the normal, every shadow would move towards the object that casts it, by the height times tan θ. Until
    such a ray is a quarter of a cell above all surfaces, it hits only where it is inside by a quarter of a
    cell, and deeper by as much than at its start: for example in a wall next to it.

    On a CPU each ray runs in a compiled loop. On other devices all rays take all steps together, without
    synchronisation.

    Args:
        grid: sampled distances, scene units.
        radius: half the edge of the cube, scene units.
        origins: starts of the rays, inside the cube.
        directions: unit directions.
        leaves_surface: whether the origins are points of a surface.
    """
    hit_distance = HIT_CELLS * cell_size(grid, radius)
    compiled = ray_tracer(origins.device.type)
    if compiled is None or grid.dtype.itemsize < 4:
        return _trace_together(grid, radius, origins, directions, hit_distance, leaves_surface)
    hits = GridHits(grid.new_empty(len(origins)), grid.new_empty(len(origins), dtype=torch.bool))
    compiled(
        grid,
        radius,
        origins.to(grid.dtype),
        directions.to(grid.dtype),
        hit_distance=hit_distance,
        leaves_surface=leaves_surface,
        steps=STEPS,
        distance=hits.distance,
        hit=hits.hit,
    )
    return hits


def _trace_together(
    grid: Float[Tensor, "R R R"],
    radius: float,
    origins: Float[Tensor, "P 3"],
    directions: Float[Tensor, "P 3"],
    hit_distance: float,
    leaves_surface: bool,
) -> GridHits:
    distance, hit = torch.zeros_like(origins[:, 0]), torch.zeros_like(origins[:, 0], dtype=torch.bool)
    gone, threshold = hit, torch.full_like(distance, hit_distance)
    if leaves_surface:
        threshold = look_up(grid, radius, origins).to(distance.dtype).clamp_max(0.0) - hit_distance
    for _ in range(STEPS):
        point = origins + distance[:, None] * directions
        clearance = look_up(grid, radius, point).to(distance.dtype)
        gone = gone | (point.abs().amax(-1) > radius)
        threshold = torch.where(clearance >= hit_distance, hit_distance, threshold)
        hit = hit | ((clearance < threshold) & ~gone)
        distance = distance + torch.where(hit | gone, 0.0, clearance.clamp_min(hit_distance))
    return GridHits(distance, hit)
