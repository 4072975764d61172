"""The surface of a finished run for the path tracer."""

from __future__ import annotations

import numpy as np
import torch

from neilfpp_method.errors import UserError
from neilfpp_method.export.mesh import shading_normals, surface_mesh
from neilfpp_method.hosts.mesh import MeshHost
from neilfpp_method.relight.surface import Surface
from neilfpp_method.train.run import Run

__all__ = ["check_material", "surface_of_run"]


def check_material(run: Run) -> None:
    """Check that the run has a material.

    Raises:
        UserError: no stage has estimated the material yet.
    """
    if not run.has_material:
        raise UserError(f"{run.path}: the run has no material at step {run.step}", "train the next stage")


@torch.no_grad()
def surface_of_run(run: Run, resolution: int) -> Surface:
    """Return the mesh the run was given, or the one that `neilfpp export --what mesh` extracts.

    Shading normals are those of training: the host's normals, smoothed if the host smooths them.

    Args:
        run: the trained run.
        resolution: number of cells along an edge of the scene's cube when a mesh is extracted.

    Raises:
        UserError: the run has no surface.
    """
    host, device = run.model.host, run.device
    if isinstance(host, MeshHost):
        triangles, normals = host.triangles.float(), host.corner_normals.float()
        smooth = shading_normals(run, triangles.reshape(-1, 3), normals.reshape(-1, 3))
        return Surface(triangles, smooth.view_as(triangles))
    mesh = surface_mesh(run, resolution)
    vertices, normals = (
        torch.from_numpy(np.asarray(part, dtype=np.float32)).to(device)
        for part in (mesh.vertices, mesh.vertex_normals)
    )
    faces = torch.from_numpy(np.asarray(mesh.faces, dtype=np.int64)).to(device)
    return Surface(vertices[faces], shading_normals(run, vertices, normals)[faces])
