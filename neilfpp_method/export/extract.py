"""The zero set of a distance field as a triangle mesh: marching cubes on a sparse grid."""

from __future__ import annotations

import math
from collections.abc import Callable

import numpy as np
import torch
import trimesh
from jaxtyping import Float
from skimage.measure import marching_cubes
from torch import Tensor

from neilfpp_method.data.memory import check_memory
from neilfpp_method.errors import UserError

__all__ = ["extract_mesh"]

Sdf = Callable[[Float[Tensor, "P 3"]], Float[Tensor, " P"]]

BLOCK = 8
"""Number of grid points along an edge of a block."""
SLACK = 1.5
"""A block is skipped if |sdf| at its centre exceeds this multiple of its half-diagonal. With blocks of 8
points no part of the surface is lost, including the edges between blocks, if the slope of the field is below
1.29.
"""
BYTES_PER_POINT = 8
"""Memory of a grid point in bytes: its distance in the order of the blocks, and in the order of the grid."""


@torch.no_grad()
def extract_mesh(
    sdf: Sdf, radius: float, resolution: int = 256, chunk: int = 65_536, device: torch.device | str = "cpu"
) -> trimesh.Trimesh:
    """Extract the zero set of a signed distance field within a sphere around the origin.

    The field is evaluated at the centres of blocks first, and then at all grid points of the blocks that the
    surface may cross.

    Args:
        sdf: signed distance, negative inside; its slope should be about 1.
        radius: only the surface within this distance of the origin is kept.
        resolution: number of grid points along an edge of the cube around the sphere, rounded up to a
            multiple of 8.
        chunk: number of points per evaluation of the field, which bounds the memory.
        device: device of the points.

    Returns:
        The mesh; faces are oriented outwards.

    Raises:
        UserError: the field has no zero set within the sphere, or the grid does not fit in memory.
    """
    blocks = math.ceil(resolution / BLOCK)
    edge = blocks * BLOCK
    step = 2.0 * radius / (edge - 1)
    remedy = "give a lower resolution, on the command line with --resolution"
    check_memory(BYTES_PER_POINT * edge**3, f"the distances of a grid of {edge}³ points", remedy)
    volume = _sparse_grid(
        lambda x: torch.cat([sdf(part) for part in x.split(chunk)]), radius, blocks, step, device
    )
    if not volume.min() < 0.0 < volume.max():
        raise _no_surface(radius)
    # By default, scikit-image orients faces towards increasing values, which is outwards.
    vertices, faces, _, _ = marching_cubes(volume, 0.0, allow_degenerate=False)
    vertices = vertices * step - radius
    inside = np.linalg.norm(vertices, axis=-1) <= radius
    faces = faces[inside[faces].all(axis=-1)]
    if not len(faces):
        raise _no_surface(radius)
    mesh = trimesh.Trimesh(vertices, faces, process=False)
    mesh.remove_unreferenced_vertices()
    return mesh


def _sparse_grid(
    sdf: Sdf, radius: float, blocks: int, step: float, device: torch.device | str
) -> Float[np.ndarray, "G G G"]:
    """Values of the field on the grid; a block far from the surface holds the value at its centre."""
    corners = _lattice(blocks, device) * (BLOCK * step) - radius
    half_edge = 0.5 * (BLOCK - 1) * step
    half_diagonal = math.sqrt(3.0) * half_edge
    centers = corners + half_edge
    coarse = sdf(centers)
    near = coarse.abs() <= SLACK * half_diagonal
    # Blocks beyond the sphere are cut off later. The margin of two steps keeps the grid edges that cross the
    # sphere exact.
    near &= centers.norm(dim=-1) <= radius + half_diagonal + 2.0 * step
    values = coarse[:, None].repeat(1, BLOCK**3)
    points = corners[near][:, None] + _lattice(BLOCK, device) * step
    if len(points):
        values[near] = sdf(points.reshape(-1, 3)).reshape(-1, BLOCK**3)
    grid = values.reshape(blocks, blocks, blocks, BLOCK, BLOCK, BLOCK).permute(0, 3, 1, 4, 2, 5)
    return grid.reshape(3 * [blocks * BLOCK]).cpu().numpy()


def _lattice(count: int, device: torch.device | str) -> Float[Tensor, "P 3"]:
    """All triples of 0 … count − 1; the last index varies fastest."""
    axis = torch.arange(count, dtype=torch.float32, device=device)
    return torch.cartesian_prod(axis, axis, axis)


def _no_surface(radius: float) -> UserError:
    return UserError(
        f"no surface within {radius:g} scene units",
        "train the stage sdf_init for longer, and check its previews",
    )
