"""The surface of a finished run for the path tracer."""

from __future__ import annotations

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from neilfpp_method.errors import UserError
from neilfpp_method.export.mesh import extract_mesh
from neilfpp_method.hosts.base import HasSdf, SmoothsNormals
from neilfpp_method.hosts.mesh import MeshHost
from neilfpp_method.hosts.volsdf import HIT_RADIUS
from neilfpp_method.relight.surface import Surface
from neilfpp_method.train.run import Run

__all__ = ["check_material", "surface_of_run"]

NORMALS_AT_ONCE = 2**14
"""Number of points per call of the host's normal smoothing, which bounds the memory."""


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
        if isinstance(host, SmoothsNormals) and run.config.volume.normal_radius > 0:
            smooth = _smoothed(host, triangles.reshape(-1, 3), normals.reshape(-1, 3))
            normals = smooth.view_as(triangles)
        return Surface(triangles, normals)
    if not isinstance(host, HasSdf):
        raise UserError(
            f"{run.path}: the host of this run has no surface to trace",
            "use a run of the VolSDF or mesh host",
        )
    mesh = extract_mesh(host.sdf, run.config.volume.radius - HIT_RADIUS, resolution, device=device)
    vertices, normals = (
        torch.from_numpy(np.asarray(part, dtype=np.float32)).to(device)
        for part in (mesh.vertices, mesh.vertex_normals)
    )
    if isinstance(host, SmoothsNormals):
        normals = _smoothed(host, vertices, normals)
    faces = torch.from_numpy(np.asarray(mesh.faces, dtype=np.int64)).to(device)
    return Surface(vertices[faces], normals[faces])


def _smoothed(
    host: SmoothsNormals, position: Float[Tensor, "N 3"], normal: Float[Tensor, "N 3"]
) -> Float[Tensor, "N 3"]:
    pairs = zip(position.split(NORMALS_AT_ONCE), normal.split(NORMALS_AT_ONCE), strict=True)
    return torch.cat([host.smooth_normals(x, n) for x, n in pairs])
