"""The surface of a run as a triangle mesh: the one that it was given, or marching cubes on a grid that is
queried only near the zero set.
"""

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

from neilfpp_method.data.images import replacing
from neilfpp_method.errors import UserError
from neilfpp_method.hosts.base import HasSdf
from neilfpp_method.hosts.mesh import MeshHost
from neilfpp_method.hosts.volsdf import HIT_RADIUS
from neilfpp_method.shading.color import tone_map
from neilfpp_method.structures import Material
from neilfpp_method.train.run import Run

__all__ = ["export_mesh", "extract_mesh", "has_surface", "materials_in_parts", "surface_mesh"]

Sdf = Callable[[Float[Tensor, "P 3"]], Float[Tensor, " P"]]

BLOCK = 8
"""Grid points along an edge of a block."""
SLACK = 1.5
"""A block is skipped when |sdf| at its centre exceeds this many of its half-diagonals. With blocks of 8
points nothing is lost, the edges between blocks included, for every field whose slope stays below 1.29.
"""
POINTS_AT_ONCE = 65_536
"""Points at which the material is asked together: bounds the memory."""


@torch.no_grad()
def extract_mesh(
    sdf: Sdf, radius: float, resolution: int = 256, chunk: int = 65_536, device: torch.device | str = "cpu"
) -> trimesh.Trimesh:
    """The zero set of a signed distance field within a sphere about the origin; faces are wound outwards.

    The grid is asked for its block centres first, then for all points of blocks that the surface may cross.

    Args:
        sdf: signed distance, negative inside; its slope should be about 1.
        radius: only the surface within this distance of the origin is kept.
        resolution: grid points along the edge of the cube around that sphere, rounded up to a multiple of 8.
        chunk: points asked at once; bounds the memory.
        device: where the points are made.

    Raises:
        UserError: the field has no zero set there.
    """
    blocks = math.ceil(resolution / BLOCK)
    step = 2.0 * radius / (blocks * BLOCK - 1)
    volume = _sparse_grid(
        lambda x: torch.cat([sdf(part) for part in x.split(chunk)]), radius, blocks, step, device
    )
    if not volume.min() < 0.0 < volume.max():
        raise _no_surface(radius)
    # scikit-image winds faces by the left hand towards growing values by default, which is outwards.
    vertices, faces, _, _ = marching_cubes(volume, 0.0, allow_degenerate=False)
    vertices = vertices * step - radius
    inside = np.linalg.norm(vertices, axis=-1) <= radius
    faces = faces[inside[faces].all(axis=-1)]
    if not len(faces):
        raise _no_surface(radius)
    mesh = trimesh.Trimesh(vertices, faces, process=False)
    mesh.remove_unreferenced_vertices()
    return mesh


def has_surface(run: Run) -> bool:
    """Whether the host of a run has a surface that can be written as a mesh."""
    return isinstance(run.model.host, HasSdf | MeshHost)


def surface_mesh(run: Run, resolution: int = 256) -> trimesh.Trimesh:
    """The surface of a run in the scene frame; faces are wound outwards.

    Args:
        run: the run.
        resolution: of `extract_mesh`; a mesh that the run was given keeps its triangles, and corners at one
            place become one.

    Raises:
        UserError: the host has no surface that is known as one, or none is found.
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
            "export from a run of another host",
        )
    volume = run.config.volume
    # The sphere that may close the scene (METHOD §3) is no surface of the object.
    device = next(run.model.parameters()).device
    return extract_mesh(host.sdf, volume.radius - HIT_RADIUS, resolution, device=device)


def export_mesh(run: Run, path: Path, resolution: int = 256) -> trimesh.Trimesh:
    """Write the surface of a run as a PLY file, in the frame and the scale of its capture.

    Vertices carry normals and, once a stage has moved the material, the base colour, sRGB-encoded, and the
    properties `roughness` and `metallic`, floats in [0, 1].

    Raises:
        UserError: see `surface_mesh`.
    """
    mesh = surface_mesh(run, resolution)
    position = torch.as_tensor(
        np.array(mesh.vertices), dtype=torch.float32, device=next(run.model.parameters()).device
    )
    if run.step > run.config.train.sdf_steps:
        material = materials_in_parts(run, position)
        mesh.visual.vertex_colors = (tone_map(material.base_color) * 255.0).round().byte().cpu().numpy()
        mesh.vertex_attributes["roughness"] = material.roughness[:, 0].cpu().numpy()
        mesh.vertex_attributes["metallic"] = material.metallic[:, 0].cpu().numpy()
    mesh.vertices = run.capture.normalisation.to_world(position.double()).cpu().numpy()
    with replacing(path) as temporary:
        temporary.write_bytes(mesh.export(file_type="ply", vertex_normal=True))
    return mesh


@torch.no_grad()
def materials_in_parts(run: Run, position: Float[Tensor, "N 3"]) -> Material:
    """The material at any number of points of the scene frame."""
    parts = [run.model.materials(part) for part in position.split(POINTS_AT_ONCE)]
    return Material(
        *(
            torch.cat([getattr(part, name) for part in parts])
            for name in ("base_color", "roughness", "metallic")
        )
    )


def _sparse_grid(
    sdf: Sdf, radius: float, blocks: int, step: float, device: torch.device | str
) -> Float[np.ndarray, "G G G"]:
    """sdf on the grid of cubes; a block far from the surface holds the value of its centre throughout."""
    corners = _lattice(blocks, device) * (BLOCK * step) - radius
    half_edge = 0.5 * (BLOCK - 1) * step
    half_diagonal = math.sqrt(3.0) * half_edge
    centres = corners + half_edge
    coarse = sdf(centres)
    near = coarse.abs() <= SLACK * half_diagonal
    # A block beyond the sphere is cut away later; two steps keep the edges that lead into it true.
    near &= centres.norm(dim=-1) <= radius + half_diagonal + 2.0 * step
    values = coarse[:, None].repeat(1, BLOCK**3)
    points = corners[near][:, None] + _lattice(BLOCK, device) * step
    if len(points):
        values[near] = sdf(points.reshape(-1, 3)).reshape(-1, BLOCK**3)
    grid = values.reshape(blocks, blocks, blocks, BLOCK, BLOCK, BLOCK).permute(0, 3, 1, 4, 2, 5)
    return grid.reshape(3 * [blocks * BLOCK]).cpu().numpy()


def _lattice(count: int, device: torch.device | str) -> Float[Tensor, "P 3"]:
    """All triples of 0 … count − 1, the last one running fastest."""
    axis = torch.arange(count, dtype=torch.float32, device=device)
    return torch.cartesian_prod(axis, axis, axis)


def _no_surface(radius: float) -> UserError:
    return UserError(
        f"no surface within {radius:g} scene units",
        "train the stage sdf_init for longer, and look at its previews",
    )
