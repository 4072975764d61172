"""A distance field sampled on a grid, and rays traced through it: visibility at the price of a look-up.

The grid spans the cube [−radius, radius]³, vertices on its faces, stored z, y, x (`grid_sample`).
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float
from torch import Tensor
from torch.nn import functional

from neilfpp_method.kernels import ray_tracer

__all__ = ["GRID_RESOLUTION", "GridHits", "cell_size", "look_up", "sample_grid", "trace_grid"]

GRID_RESOLUTION = 96
"""Vertices along an edge of the grid that hard inter-reflection traces."""
CHUNK = 65_536
STEPS = 40
"""Most steps of a ray; one that has not ended by then passes close to a surface without meeting it."""
HIT_CELLS = 0.25
"""A ray meets the surface where the distance is below this share of a cell: the interpolation error."""


def cell_size(grid: Float[Tensor, "R R R"], radius: float) -> float:
    """Edge of a cell."""
    return 2 * radius / (grid.shape[0] - 1)


@torch.no_grad()
def sample_grid(
    sdf: Callable[[Float[Tensor, "P 3"]], Float[Tensor, " P"]], radius: float, resolution: int, like: Tensor
) -> Float[Tensor, "R R R"]:
    """The distance at resolution³ vertices, on the device and in the type of `like`."""
    axis = torch.linspace(-radius, radius, resolution, device=like.device, dtype=like.dtype)
    z, y, x = torch.meshgrid(axis, axis, axis, indexing="ij")
    vertices = torch.stack((x, y, z), -1).reshape(-1, 3)
    return torch.cat([sdf(part) for part in vertices.split(CHUNK)]).reshape(
        resolution, resolution, resolution
    )


def look_up(grid: Float[Tensor, "R R R"], radius: float, x: Float[Tensor, "P 3"]) -> Float[Tensor, " P"]:
    """The distance at points, by trilinear interpolation; beyond the cube that of the nearest face point."""
    at = (x / radius).view(1, -1, 1, 1, 3)
    return functional.grid_sample(grid[None, None], at, padding_mode="border", align_corners=True).view(-1)


@dataclass(frozen=True)
class GridHits:
    """Where rays meet the surface: the distance along the ray, and whether before they leave the cube."""

    distance: Float[Tensor, " P"]
    hit: Bool[Tensor, " P"]


@torch.no_grad()
def trace_grid(
    grid: Float[Tensor, "R R R"],
    radius: float,
    origins: Float[Tensor, "P 3"],
    directions: Float[Tensor, "P 3"],
) -> GridHits:
    """Sphere tracing: each step goes as far as the distance allows, and at least a quarter of a cell.

    On a CPU by compiled loops; elsewhere all rays take all steps together, without synchronisation.
    """
    least = HIT_CELLS * cell_size(grid, radius)
    compiled = ray_tracer(origins.device.type)
    if compiled is None or grid.dtype.itemsize < 4:
        return _trace_together(grid, radius, origins, directions, least)
    found = GridHits(grid.new_empty(len(origins)), grid.new_empty(len(origins), dtype=torch.bool))
    compiled(
        grid,
        radius,
        origins.to(grid.dtype),
        directions.to(grid.dtype),
        least,
        STEPS,
        found.distance,
        found.hit,
    )
    return found


def _trace_together(
    grid: Float[Tensor, "R R R"],
    radius: float,
    origins: Float[Tensor, "P 3"],
    directions: Float[Tensor, "P 3"],
    least: float,
) -> GridHits:
    distance, hit = torch.zeros_like(origins[:, 0]), torch.zeros_like(origins[:, 0], dtype=torch.bool)
    gone = hit
    for _ in range(STEPS):
        point = origins + distance[:, None] * directions
        clearance = look_up(grid, radius, point).to(distance.dtype)
        gone = gone | (point.abs().amax(-1) > radius)
        hit = hit | ((clearance < least) & ~gone)
        distance = distance + torch.where(hit | gone, 0.0, clearance.clamp_min(least))
    return GridHits(distance, hit)
