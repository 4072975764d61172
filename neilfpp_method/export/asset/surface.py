"""The fine surface of a run, from which an asset is simplified, and intersections of normals with it."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
import torch
import trimesh
from jaxtyping import Bool, Float, Int, Shaped
from torch import Tensor

from neilfpp_method.data.mesh import Mesh
from neilfpp_method.export.mesh import surface_mesh
from neilfpp_method.export.surface_cache import shaded_surface, shading_normals
from neilfpp_method.hosts.mesh import MeshHost, corner_normals
from neilfpp_method.hosts.mesh_tracing import FirstHits, face_normals, first_hits_of, intersect_planes
from neilfpp_method.shading.frame import safe_normalize
from neilfpp_method.train.run import Run

__all__ = ["AssetSurface", "NormalHits", "creased", "fine_surface", "first_hits", "hits_along_normals"]

STEP_BACK = 1e-4
"""Distance that a ray starts behind its point, scene units, so that it hits a surface through the point."""


@dataclass(frozen=True)
class AssetSurface:
    """Triangles in the scene frame, oriented outwards, with a unit normal at each corner."""

    vertices: Float[np.ndarray, "V 3"]
    faces: Int[np.ndarray, "F 3"]
    normals: Float[np.ndarray, "F 3 3"]

    def part(self, chosen: Shaped[np.ndarray, " K"]) -> AssetSurface:
        """Select triangles by index or mask; all vertices are kept."""
        return replace(self, faces=self.faces[chosen], normals=self.normals[chosen])

    def mesh(self) -> trimesh.Trimesh:
        """The same triangles, in the same order, as a trimesh mesh."""
        return trimesh.Trimesh(self.vertices, self.faces, process=False)

    def triangles(self) -> Float[Tensor, "F 3 3"]:
        """The corners of each triangle."""
        return torch.from_numpy(self.vertices[self.faces]).float()


@torch.no_grad()
def fine_surface(run: Run, resolution: int, say: Callable[[str], None] = lambda text: None) -> AssetSurface:
    """Return the surface that `export --what mesh` writes, with the normals that the run uses for shading.

    Args:
        run: a run with a mesh or a distance field.
        resolution: resolution of `shaded_surface` for a distance field.
        say: receives a message if a file in the run folder is replaced.

    Raises:
        UserError: the field has no zero set.
    """
    host = run.model.host
    if isinstance(host, MeshHost):
        mesh = surface_mesh(run)
        position, normal = host.triangles.reshape(-1, 3), host.corner_normals.reshape(-1, 3)
        normals = shading_normals(run.model, position, normal).double().cpu().numpy().reshape(-1, 3, 3)
        return AssetSurface(np.array(mesh.vertices, np.float64), np.array(mesh.faces), normals)
    surface = shaded_surface(run, resolution, say)
    faces = surface.faces.astype(np.int64)
    return AssetSurface(surface.vertices.astype(np.float64), faces, surface.normals.astype(np.float64)[faces])


def creased(vertices: Float[np.ndarray, "V 3"], faces: Int[np.ndarray, "F 3"]) -> AssetSurface:
    """Build a surface with normals from its triangles: smooth, except at creases (`corner_normals`)."""
    mesh = Mesh(torch.from_numpy(vertices).float(), torch.from_numpy(faces).long())
    normals = corner_normals(mesh, face_normals(mesh.vertices[mesh.faces]))
    return AssetSurface(vertices, faces, normals.double().numpy())


def first_hits(surface: AssetSurface) -> FirstHits:
    """Make a function that returns the first triangle hit by each ray."""
    return first_hits_of(surface.triangles())


@dataclass(frozen=True)
class NormalHits:
    """Intersections of the normals of N points with a surface.

    Attributes:
        valid: whether there is an intersection.
        distance: distance from the point, scene units.
        position: the intersection; the point itself if there is none.
        normal: unit normal there; that of the point if there is none.
    """

    valid: Bool[np.ndarray, " N"]
    distance: Float[np.ndarray, " N"]
    position: Float[np.ndarray, "N 3"]
    normal: Float[np.ndarray, "N 3"]


def hits_along_normals(
    surface: AssetSurface,
    tracer: FirstHits,
    position: Float[np.ndarray, "N 3"],
    normal: Float[np.ndarray, "N 3"],
    reach: float,
) -> NormalHits:
    """Intersect the line through each point along its normal with a surface, and keep the nearest hit.

    Only hits within `reach`, on parts of the surface that face the same way as the normal, count.

    Args:
        surface: the surface.
        tracer: `first_hits` of the surface.
        position: points, scene frame.
        normal: unit normals.
        reach: largest distance, scene units.
    """
    origin, along = torch.from_numpy(position).float(), torch.from_numpy(normal).float()
    triangles, corners = surface.triangles(), torch.from_numpy(surface.normals).float()
    nearest = torch.full_like(origin[:, 0], reach)
    hit_position, hit_normal = origin.clone(), along.clone()
    valid = torch.zeros(len(origin), dtype=torch.bool)
    for direction in (along, -along):
        start = origin - STEP_BACK * direction
        face = tracer(start, direction)
        rows = torch.nonzero(face >= 0)[:, 0]
        if not len(rows):
            continue
        hit = intersect_planes(start[rows], direction[rows], triangles[face[rows]])
        shaded = safe_normalize((hit.weights.clamp(0, 1)[..., None] * corners[face[rows]]).sum(1))
        distance = (hit.distance - STEP_BACK).abs()
        nearer = (distance < nearest[rows]) & ((shaded * along[rows]).sum(-1) > 0)
        rows, distance = rows[nearer], distance[nearer]
        nearest[rows], valid[rows], hit_normal[rows] = distance, True, shaded[nearer]
        hit_position[rows] = start[rows] + hit.distance[nearer, None] * direction[rows]
    return NormalHits(valid.numpy(), nearest.numpy(), hit_position.numpy(), hit_normal.numpy())
