"""Oriented points fused into a sampled distance field: what has been seen of a surface, made traceable.

Near the points the distance is the weighted mean of the distances from their tangent planes (an implicit
moving least-squares surface, Kolluri 2008; as a volume, Curless and Levoy 1996). Further away it is a lower
bound of the distance from any vertex that is close to the surface, so that sphere tracing is safe and what
nobody has seen is empty.
"""

from __future__ import annotations

from dataclasses import dataclass

import torch
from jaxtyping import Float
from scipy.ndimage import distance_transform_edt
from torch import Tensor
from torch.nn.functional import normalize

from neilfpp_method.volume.distance_grid import cell_size, look_up

__all__ = ["FusedSurface", "fuse", "grid_normal", "mean_at"]

WIDTH = 0.75
"""Standard deviation of a point's influence, in cells: the next vertices, and little beyond. It flattens a
surface of curvature κ by about WIDTH² κ / 2 cells squared.
"""
BEHIND = 1.25
"""How far behind its plane a point counts, in cells: less than the thickness of thin objects."""
KNOWN = 0.15
"""Least weight sum of a vertex with a known distance; a point one and a half cells away has 0.14."""
HALF_DIAGONAL = 0.87
"""In cells: a vertex of the cell that holds a surface is no further from it."""
AT_ONCE = 8192
"""Points that are fused together: bounds the memory."""


@dataclass(frozen=True)
class FusedSurface:
    """Distances at the cube's vertices, z, y, x; for means, the sums of weights and weighted values."""

    distance: Float[Tensor, "R R R"]
    weight: Float[Tensor, "R R R"]
    value: Float[Tensor, "C R R R"]


@torch.no_grad()
def fuse(
    position: Float[Tensor, "P 3"],
    normal: Float[Tensor, "P 3"],
    value: Float[Tensor, "P C"],
    radius: float,
    resolution: int,
) -> FusedSurface:
    """The surface through oriented points, with the mean of what they hold.

    Args:
        position: scene frame; what lies outside the cube [−radius, radius]³ is left out.
        normal: unit, away from the surface.
        value: numbers of each point, radiance say.
        radius: half the edge of the cube.
        resolution: vertices along an edge.
    """
    edge = 2 * radius / (resolution - 1)
    sums = position.new_zeros(2 + value.shape[1], resolution**3)  # weight, weighted distance, weighted values
    inside = (position.abs() < radius - 2 * edge).all(-1)
    steps = torch.arange(-1, 3, device=position.device)
    around = torch.stack(torch.meshgrid(steps, steps, steps, indexing="ij"), -1).reshape(-1, 3)
    for x, n, v in zip(*(t[inside].split(AT_ONCE) for t in (position, normal, value)), strict=True):
        vertex = ((x + radius) / edge).floor().long()[:, None] + around
        offset = vertex.to(x.dtype) * edge - radius - x[:, None]
        height = (offset * n[:, None]).sum(-1)
        weight = (-0.5 * offset.square().sum(-1) / (WIDTH * edge) ** 2).exp() * (height > -BEHIND * edge)
        flat = ((vertex[..., 2] * resolution + vertex[..., 1]) * resolution + vertex[..., 0]).reshape(-1)
        columns = torch.stack((weight, weight * height, *(weight * c[:, None] for c in v.unbind(-1))))
        sums.index_add_(1, flat, columns.flatten(1))
    sums = sums.view(-1, resolution, resolution, resolution)
    weight, height = sums[0], sums[1] / sums[0].clamp_min(1e-6)
    known = weight >= KNOWN
    return FusedSurface(
        torch.where(known, height, _far(known & (height.abs() < HALF_DIAGONAL * edge), edge)),
        weight,
        sums[2:],
    )


def mean_at(surface: FusedSurface, radius: float, x: Float[Tensor, "P 3"]) -> Float[Tensor, "P C"]:
    """The weighted mean of the values about points; 0 where nothing is known."""
    weight = look_up(surface.weight, radius, x)
    values = torch.stack([look_up(channel, radius, x) for channel in surface.value], -1)
    return values / weight.clamp_min(1e-6)[:, None]


def grid_normal(grid: Float[Tensor, "R R R"], radius: float, x: Float[Tensor, "P 3"]) -> Float[Tensor, "P 3"]:
    """Unit gradient of a sampled distance field, by central differences over a cell; 0 where it is flat."""
    step = 0.5 * cell_size(grid, radius)
    ends = torch.cat([x + sign * step * axis for axis in torch.eye(3).to(x) for sign in (1.0, -1.0)])
    values = look_up(grid, radius, ends).view(3, 2, len(x))
    return normalize((values[:, 0] - values[:, 1]).T, dim=-1)


def _far(near: Tensor, edge: float) -> Float[Tensor, "R R R"]:
    """A lower bound of the surface's distance: the nearest vertex beside it, less half a cell diagonal."""
    if not near.any():
        return torch.full(near.shape, near.shape[0] * edge, device=near.device)
    cells = torch.from_numpy(distance_transform_edt((~near).cpu().numpy())).to(near.device, torch.float32)
    return (cells - HALF_DIAGONAL).clamp_min(0.5) * edge
