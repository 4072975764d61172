"""The surface of a run as a triangle mesh: the mesh it was given, or marching cubes on a sparse grid."""

from __future__ import annotations

import math
from collections.abc import Callable
from pathlib import Path

import numpy as np
import torch
import trimesh
from jaxtyping import Float
from skimage.measure import marching_cubes
from torch import Tensor

from neilfpp_method.data.memory import check_memory
from neilfpp_method.data.ply import NORMAL, write_ply
from neilfpp_method.errors import UserError
from neilfpp_method.hosts.base import HasSdf, SmoothsNormals
from neilfpp_method.hosts.mesh import MeshHost
from neilfpp_method.hosts.volsdf import HIT_RADIUS
from neilfpp_method.shading.color import tone_map
from neilfpp_method.structures import Material
from neilfpp_method.train.run import Run

__all__ = [
    "check_resolution",
    "export_mesh",
    "extract_mesh",
    "has_surface",
    "materials_in_parts",
    "shading_normals",
    "surface_mesh",
]

Sdf = Callable[[Float[Tensor, "P 3"]], Float[Tensor, " P"]]

BLOCK = 8
"""Number of grid points along an edge of a block."""
SLACK = 1.5
"""A block is skipped if |sdf| at its centre exceeds this multiple of its half-diagonal. With blocks of 8
points no part of the surface is lost, including the edges between blocks, if the slope of the field is below
1.29.
"""
MIN_RESOLUTION, MAX_RESOLUTION = 8, 2048
"""Bounds of the resolution of a command; a grid of 2048³ distances takes 34 GB, its copy another 34 GB."""
BYTES_PER_POINT = 8
"""Memory of a grid point in bytes: its distance in the order of the blocks, and in the order of the grid."""
POINTS_AT_ONCE = 65_536
"""Number of points per evaluation of the material, which bounds the memory."""
NORMALS_AT_ONCE = 2**14
"""Number of points per call of the host's normal smoothing, which reads 32 neighbours of each."""


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


def check_resolution(resolution: int) -> None:
    """Check the option --resolution of a command that extracts a mesh.

    Raises:
        UserError: it is out of range.
    """
    if not MIN_RESOLUTION <= resolution <= MAX_RESOLUTION:
        raise UserError(
            f"a surface cannot have a grid of {resolution} cells per side",
            f"give {MIN_RESOLUTION} to {MAX_RESOLUTION} with --resolution",
        )


def has_surface(run: Run) -> bool:
    """Whether the host of a run has a distance field or a mesh, so that a mesh can be written."""
    return isinstance(run.model.host, HasSdf | MeshHost)


def surface_mesh(run: Run, resolution: int = 256) -> trimesh.Trimesh:
    """Return the surface of a run in the scene frame; faces are oriented outwards.

    A mesh that the run was given keeps its triangles; corners at the same position are merged.

    Args:
        run: the run.
        resolution: resolution of `extract_mesh` for a distance field.

    Raises:
        UserError: the host has neither a distance field nor a mesh, or the field has no zero set.
    """
    host = run.model.host
    if isinstance(host, MeshHost):
        corners = host.triangles.reshape(-1, 3).cpu().double().numpy()
        mesh = trimesh.Trimesh(corners, np.arange(len(corners)).reshape(-1, 3), process=False)
        mesh.merge_vertices()
        return mesh
    if not isinstance(host, HasSdf):
        raise UserError(
            f"{run.path}: the host of this run has no distance field and no mesh",
            "use a run of the VolSDF or mesh host",
        )
    # Stay inside the sphere that may close the scene, which is no surface of the object.
    return extract_mesh(host.sdf, run.config.volume.radius - HIT_RADIUS, resolution, device=run.device)


def export_mesh(run: Run, path: Path, resolution: int = 256) -> trimesh.Trimesh:
    """Write the surface of a run as a PLY file in the world frame of its capture.

    Vertices have normals. If a stage has estimated the material, they also have the base colour,
    sRGB-encoded, and the properties `roughness` and `metallic`, floats in [0, 1].

    Raises:
        UserError: `surface_mesh` fails.
    """
    mesh = surface_mesh(run, resolution)
    position = torch.as_tensor(np.array(mesh.vertices), dtype=torch.float32, device=run.device)
    columns = dict(zip(NORMAL, mesh.vertex_normals.astype(np.float32).T, strict=True))
    if run.has_material:
        material = materials_in_parts(run, position)
        color = (tone_map(material.base_color) * 255.0).round().byte().cpu().numpy()
        opaque = np.full(len(color), 255, dtype=np.uint8)
        columns |= zip(("red", "green", "blue", "alpha"), (*color.T, opaque), strict=True)
        columns["roughness"] = material.roughness[:, 0].cpu().numpy()
        columns["metallic"] = material.metallic[:, 0].cpu().numpy()
    mesh.vertices = run.capture.normalization.to_world(position.double()).cpu().numpy()
    write_ply(path, np.array(mesh.vertices), columns, np.array(mesh.faces))
    return mesh


@torch.no_grad()
def materials_in_parts(run: Run, position: Float[Tensor, "N 3"]) -> Material:
    """Evaluate the material at any number of points of the scene frame, in batches."""
    parts = [run.model.materials(part) for part in position.split(POINTS_AT_ONCE)]
    return Material.joined(parts)


@torch.no_grad()
def shading_normals(
    run: Run, position: Float[Tensor, "N 3"], normal: Float[Tensor, "N 3"]
) -> Float[Tensor, "N 3"]:
    """The normals with which a run shades points of its surface: smoothed if the host smooths them."""
    host = run.model.host
    if not isinstance(host, SmoothsNormals):
        return normal
    parts = zip(position.split(NORMALS_AT_ONCE), normal.split(NORMALS_AT_ONCE), strict=True)
    return torch.cat([host.smooth_normals(places, normals) for places, normals in parts])


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
