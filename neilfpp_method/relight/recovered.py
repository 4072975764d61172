"""The surface of a finished run for the path tracer."""

from __future__ import annotations

from collections.abc import Callable

import torch

from neilfpp_method.errors import UserError
from neilfpp_method.export.surface_cache import shaded_surface, shading_normals
from neilfpp_method.hosts.base import HasSdf
from neilfpp_method.hosts.mesh import MeshHost
from neilfpp_method.relight.surface import Surface
from neilfpp_method.train.run import Run

__all__ = ["surface_of_run"]


@torch.no_grad()
def surface_of_run(
    run: Run, resolution: int, say: Callable[[str], None] = lambda text: None, keep: bool = True
) -> Surface:
    """Return the mesh the run was given, or the one that `neilfpp export --what mesh` extracts.

    Shading normals are those of training (`NeilfModel.shading_normals`).

    Args:
        run: the trained run.
        resolution: number of cells along an edge of the scene's cube when a mesh is extracted.
        say: receives a message if a file in the run folder is replaced.
        keep: whether an extracted mesh is kept in the run folder.

    Raises:
        UserError: the run has no surface.
    """
    host = run.model.host
    if isinstance(host, MeshHost):
        triangles, normals = host.triangles.float(), host.corner_normals.float()
        smooth = shading_normals(run.model, triangles.reshape(-1, 3), normals.reshape(-1, 3))
        return Surface(triangles, smooth.view_as(triangles))
    if not isinstance(host, HasSdf):
        raise UserError(
            f"{run.path}: the host of this run has no surface to trace",
            "use a run of the VolSDF or mesh host",
        )
    surface = shaded_surface(run, resolution, say, keep)
    triangles, corner_normals = (
        torch.from_numpy(values[surface.faces]).to(run.device)
        for values in (surface.vertices, surface.normals)
    )
    return Surface(triangles, corner_normals)
