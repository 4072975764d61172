"""The surface of a run as a triangle mesh: the mesh it was given, or marching cubes on a sparse grid."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import numpy as np
import torch
import trimesh
from jaxtyping import Float
from torch import Tensor

from neilfpp_method.data.files.ply import NORMAL, write_ply
from neilfpp_method.errors import UserError
from neilfpp_method.export.surface_cache import extracted_surface
from neilfpp_method.hosts.base import HasSdf
from neilfpp_method.hosts.mesh import MeshHost
from neilfpp_method.shading.color import tone_map
from neilfpp_method.structures import Material
from neilfpp_method.train.run import Run

__all__ = ["check_resolution", "export_mesh", "has_surface", "materials_in_parts", "surface_mesh"]

MIN_RESOLUTION, MAX_RESOLUTION = 8, 2048
"""Bounds of the resolution of a command; a grid of 2048³ distances takes 34 GB, its copy another 34 GB."""
POINTS_AT_ONCE = 65_536
"""Number of points per evaluation of the material, which bounds the memory."""


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


def surface_mesh(
    run: Run, resolution: int = 256, say: Callable[[str], None] = lambda text: None
) -> trimesh.Trimesh:
    """Return the surface of a run in the scene frame; faces are oriented outwards.

    A mesh that the run was given keeps its triangles; corners at the same position are merged.

    Args:
        run: the run.
        resolution: resolution of `extracted_surface` for a distance field.
        say: receives a message if a file in the run folder is replaced.

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
    return extracted_surface(run, resolution, say).mesh()


def export_mesh(
    run: Run, path: Path, resolution: int = 256, say: Callable[[str], None] = lambda text: None
) -> trimesh.Trimesh:
    """Write the surface of a run as a PLY file in the world frame of its capture.

    Vertices have normals. If a stage has estimated the material, they also have the base colour,
    sRGB-encoded, and the properties `roughness` and `metallic`, floats in [0, 1].

    Raises:
        UserError: `surface_mesh` fails.
    """
    mesh = surface_mesh(run, resolution, say)
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
