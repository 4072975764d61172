"""The fine surface of a run, of which an asset is a coarser copy; and where rays along normals meet it."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
import torch
import trimesh
from jaxtyping import Bool, Float, Int, Shaped
from torch import Tensor

from neilfpp_method.data.mesh import Mesh
from neilfpp_method.export.mesh import surface_mesh
from neilfpp_method.hosts.base import SmoothsNormals
from neilfpp_method.hosts.mesh import MeshHost, corner_normals
from neilfpp_method.hosts.mesh_tracing import FirstHits, build_tree, embree_tracer, meet, tree_tracer
from neilfpp_method.shading.frame import safe_normalize
from neilfpp_method.train.run import Run

__all__ = ["Footing", "Surface", "creased", "fine_surface", "first_hits", "meet_along"]

POINTS_AT_ONCE = 2**14
"""Points whose normals are smoothed together: each asks 32 neighbours."""
STEP_BACK = 1e-4
"""Scene units that a ray starts behind its point, so that a surface through the point itself is met."""


@dataclass(frozen=True)
class Surface:
    """Triangles of the scene frame, wound outwards, with a unit normal at each of their corners."""

    vertices: Float[np.ndarray, "V 3"]
    faces: Int[np.ndarray, "F 3"]
    normals: Float[np.ndarray, "F 3 3"]

    def part(self, chosen: Shaped[np.ndarray, " K"]) -> Surface:
        """Some of the triangles, by number or by mask; all vertices stay."""
        return replace(self, faces=self.faces[chosen], normals=self.normals[chosen])

    def mesh(self) -> trimesh.Trimesh:
        """The triangles for trimesh, number by number."""
        return trimesh.Trimesh(self.vertices, self.faces, process=False)

    def triangles(self) -> Float[Tensor, "F 3 3"]:
        """The corners of each triangle."""
        return torch.from_numpy(self.vertices[self.faces]).float()


@torch.no_grad()
def fine_surface(run: Run, resolution: int) -> Surface:
    """The surface that `export --what mesh` writes, with the normals that the run shades it with.

    Raises:
        UserError: see `surface_mesh`.
    """
    mesh, host = surface_mesh(run, resolution), run.model.host
    faces, vertices = np.array(mesh.faces), np.array(mesh.vertices, dtype=np.float64)
    if isinstance(host, MeshHost):
        position, normal = host.triangles.reshape(-1, 3), host.corner_normals.reshape(-1, 3)
        return Surface(vertices, faces, _shading_normals(host, position, normal).reshape(-1, 3, 3))
    device = next(run.model.parameters()).device
    position, normal = (
        torch.as_tensor(np.array(a), dtype=torch.float32, device=device)
        for a in (vertices, mesh.vertex_normals)
    )
    return Surface(vertices, faces, _shading_normals(host, position, normal)[faces])


def creased(vertices: Float[np.ndarray, "V 3"], faces: Int[np.ndarray, "F 3"]) -> Surface:
    """A surface with the normals that its triangles give: smooth, but for edges (`corner_normals`)."""
    mesh = Mesh(torch.from_numpy(vertices).float(), torch.from_numpy(faces).long())
    triangles = mesh.vertices[mesh.faces]
    across = torch.linalg.cross(triangles[:, 1] - triangles[:, 0], triangles[:, 2] - triangles[:, 0])
    return Surface(vertices, faces, corner_normals(mesh, safe_normalize(across, eps=1e-18)).double().numpy())


def first_hits(surface: Surface) -> FirstHits:
    """Which triangle a ray meets first: Embree, or a tree where Embree is not installed."""
    triangles = surface.triangles()
    return embree_tracer(triangles) or tree_tracer(build_tree(triangles))


@dataclass(frozen=True)
class Footing:
    """Where points come down on a surface along their normals: whether at all, how far, and the place and the
    unit normal there. Where not, the place and the normal are those of the point."""

    found: Bool[np.ndarray, " N"]
    distance: Float[np.ndarray, " N"]
    position: Float[np.ndarray, "N 3"]
    normal: Float[np.ndarray, "N 3"]


def meet_along(
    surface: Surface,
    tracer: FirstHits,
    position: Float[np.ndarray, "N 3"],
    normal: Float[np.ndarray, "N 3"],
    reach: float,
) -> Footing:
    """The nearer hit of a point's normal and its opposite, within a distance, on a side facing the same way.

    Args:
        surface: where the points come down.
        tracer: its `first_hits`.
        position: points, scene frame.
        normal: unit; the line to look along.
        reach: the largest distance, scene units.
    """
    origin, along = torch.from_numpy(position).float(), torch.from_numpy(normal).float()
    triangles, corners = surface.triangles(), torch.from_numpy(surface.normals).float()
    nearest = torch.full_like(origin[:, 0], reach)
    place, turned, found = origin.clone(), along.clone(), torch.zeros(len(origin), dtype=torch.bool)
    for direction in (along, -along):
        start = origin - STEP_BACK * direction
        face = tracer(start, direction)
        rows = torch.nonzero(face >= 0)[:, 0]
        if not len(rows):
            continue
        hit = meet(start[rows], direction[rows], triangles[face[rows]])
        shaded = safe_normalize((hit.weights.clamp(0, 1)[..., None] * corners[face[rows]]).sum(1))
        distance = (hit.distance - STEP_BACK).abs()
        good = (distance < nearest[rows]) & ((shaded * along[rows]).sum(-1) > 0)
        rows, distance = rows[good], distance[good]
        nearest[rows], found[rows], turned[rows] = distance, True, shaded[good]
        place[rows] = start[rows] + hit.distance[good, None] * direction[rows]
    return Footing(found.numpy(), nearest.numpy(), place.numpy(), turned.numpy())


def _shading_normals(
    host: object, position: Float[Tensor, "N 3"], normal: Float[Tensor, "N 3"]
) -> Float[np.ndarray, "N 3"]:
    if isinstance(host, SmoothsNormals):
        pairs = zip(position.split(POINTS_AT_ONCE), normal.split(POINTS_AT_ONCE), strict=True)
        normal = torch.cat([host.smooth_normals(places, normals) for places, normals in pairs])
    return normal.double().cpu().numpy()
