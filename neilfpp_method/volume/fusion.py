"""Fusion of oriented points into a sampled distance field, in which rays can be traced.

Near the points the distance is the weighted mean of the distances from their tangent planes (an implicit
moving least-squares surface, Kolluri 2008; as a volume, Curless and Levoy 1996). Further away it is a lower
bound on the distance to the closest vertex at the surface, so that sphere tracing is safe. Space without
points is empty.
"""

from __future__ import annotations

from dataclasses import dataclass

import torch
from jaxtyping import Float
from scipy.ndimage import distance_transform_edt
from torch import Tensor
from torch.nn.functional import normalize

from neilfpp_method.volume.distance_grid import cell_size, look_up

__all__ = ["FusedSurface", "fuse_surface", "grid_normal", "mean_at"]

WIDTH = 0.75
"""Standard deviation of a point's weight, in cells: it reaches the closest vertices and little beyond. It
shifts a surface of curvature κ by about WIDTH² κ / 2 cells squared.
"""
MAX_DISTANCE_BEHIND = 1.25
"""Largest distance behind its plane at which a point has weight, in cells: less than thin objects have."""
MIN_WEIGHT = 0.15
"""Smallest sum of weights at a vertex with a known distance; a point 1.5 cells away has a weight of 0.14."""
HALF_DIAGONAL = 0.87
"""Half the diagonal of a cell, in cells: some vertex of a cell with a surface is at most this far from it."""
POINTS_AT_ONCE = 8192
"""Points per batch of the fusion; limits memory."""


@dataclass(frozen=True)
class FusedSurface:
    """Distances at the vertices of the cube (z, y, x), and the sums of weights and of weighted values."""

    distance: Float[Tensor, "R R R"]
    weight: Float[Tensor, "R R R"]
    value: Float[Tensor, "C R R R"]


@torch.no_grad()
def fuse_surface(
    position: Float[Tensor, "P 3"],
    normal: Float[Tensor, "P 3"],
    value: Float[Tensor, "P C"],
    radius: float,
    resolution: int,
) -> FusedSurface:
    """Fuse oriented points with values into a surface.

    Args:
        position: points, scene frame; those outside of the cube [−radius, radius]³ are left out.
        normal: outward unit normals.
        value: values of each point to average, for example radiance.
        radius: half the edge of the cube.
        resolution: vertices along an edge.
    """
    edge = 2 * radius / (resolution - 1)
    # Rows: sums of weights, of weighted distances, and of weighted values.
    sums = position.new_zeros(2 + value.shape[1], resolution**3)
    inside = (position.abs() < radius - 2 * edge).all(-1)
    steps = torch.arange(-1, 3, device=position.device)
    around = torch.stack(torch.meshgrid(steps, steps, steps, indexing="ij"), -1).reshape(-1, 3)
    for x, n, v in zip(*(t[inside].split(POINTS_AT_ONCE) for t in (position, normal, value)), strict=True):
        vertex = ((x + radius) / edge).floor().long()[:, None] + around
        offset = vertex.to(x.dtype) * edge - radius - x[:, None]
        height = (offset * n[:, None]).sum(-1)
        weight = (-0.5 * offset.square().sum(-1) / (WIDTH * edge) ** 2).exp() * (
            height > -MAX_DISTANCE_BEHIND * edge
        )
        flat = ((vertex[..., 2] * resolution + vertex[..., 1]) * resolution + vertex[..., 0]).reshape(-1)
        columns = torch.stack((weight, weight * height, *(weight * c[:, None] for c in v.unbind(-1))))
        sums.index_add_(1, flat, columns.flatten(1))
    sums = sums.view(-1, resolution, resolution, resolution)
    weight, height = sums[0], sums[1] / sums[0].clamp_min(1e-6)
    known = weight >= MIN_WEIGHT
    return FusedSurface(
        torch.where(known, height, _far(known & (height.abs() < HALF_DIAGONAL * edge), edge)),
        weight,
        sums[2:],
    )


def mean_at(surface: FusedSurface, radius: float, x: Float[Tensor, "P 3"]) -> Float[Tensor, "P C"]:
    """Weighted mean of the values around points; 0 where there are none."""
    weight = look_up(surface.weight, radius, x)
    values = torch.stack([look_up(channel, radius, x) for channel in surface.value], -1)
    return values / weight.clamp_min(1e-6)[:, None]


def grid_normal(grid: Float[Tensor, "R R R"], radius: float, x: Float[Tensor, "P 3"]) -> Float[Tensor, "P 3"]:
    """Unit gradient of a sampled distance field, by central differences; 0 where it is constant."""
    step = 0.5 * cell_size(grid, radius)
    ends = torch.cat([x + sign * step * axis for axis in torch.eye(3).to(x) for sign in (1.0, -1.0)])
    values = look_up(grid, radius, ends).view(3, 2, len(x))
    return normalize((values[:, 0] - values[:, 1]).T, dim=-1)


def _far(near: Tensor, edge: float) -> Float[Tensor, "R R R"]:
    """Lower bound on the distance: that to the closest vertex at the surface, minus half a diagonal."""
    if not near.any():
        return torch.full(near.shape, near.shape[0] * edge, device=near.device)
    cells = torch.from_numpy(distance_transform_edt((~near).cpu().numpy())).to(near.device, torch.float32)
    return (cells - HALF_DIAGONAL).clamp_min(0.5) * edge
