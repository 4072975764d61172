"""Host with given geometry: a triangle mesh with a surface light field (METHOD §5)."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
import trimesh
from jaxtyping import Bool, Float, Float64, Int
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components
from torch import Tensor, nn

from neilfpp_method.data.mesh import Mesh
from neilfpp_method.errors import UserError
from neilfpp_method.hosts.mesh_tracing import (
    TINY,
    FirstHits,
    face_normals,
    first_hits_of,
    intersect_planes,
    normals_towards_viewer,
)
from neilfpp_method.hosts.radiance import background_field, radiance_field
from neilfpp_method.schedule import FIXED_GEOMETRY
from neilfpp_method.settings.facts import SceneFacts
from neilfpp_method.settings.types import NeilfConfig
from neilfpp_method.shading.frame import safe_normalize
from neilfpp_method.structures import RayBatch, SceneLight, SurfaceHits

__all__ = ["MeshHost", "corner_normals"]

SAME_MESH = 1e-6
"""Difference of fingerprints up to which two meshes are the same. Rounding on another processor changes them
by about 1e-8.
"""
CREASE_ANGLE = math.radians(40)
"""Angle between the normals of two faces above which their common edge is sharp; otherwise normals are
interpolated across it.
"""
RADIANCE_AT_ONCE = 2**16
"""Number of points per evaluation of R when light is traced; limits memory."""


@dataclass(frozen=True)
class MeshHits:
    """Rays that hit the mesh: rows, positions and normals of the hits, and whether they hit the outside."""

    rows: Int[Tensor, " K"]
    position: Float[Tensor, "K 3"]
    normal: Float[Tensor, "K 3"]
    outside: Bool[Tensor, " K"]


class MeshHost(nn.Module):
    """A triangle mesh and R on it. Only R and the background are trained.

    Faces are oriented outwards. The inside of a face stops a ray but is not a hit. Checkpoints do not contain
    the mesh, but the number and moments of its corners: R is a function of position, and on another surface
    its values have no meaning.

    Args:
        mesh: triangles in the scene frame.
        config: the settings.
        facts: the range and the initial value of R, and the background: "inverted_sphere", or constant for
            any other value.
    """

    stages = FIXED_GEOMETRY

    def __init__(self, mesh: Mesh, config: NeilfConfig, facts: SceneFacts) -> None:
        super().__init__()
        self.radiance_field = radiance_field(config, facts, 0)
        self.register_buffer("background_color", torch.tensor(facts.background_color))
        self.background = background_field(config, facts)
        triangles = mesh.vertices[mesh.faces]
        outward = face_normals(triangles)
        smooth = corner_normals(mesh, outward)
        self.register_buffer("triangles", triangles, persistent=False)
        self.register_buffer("outward", outward, persistent=False)
        self.register_buffer("corner_normals", smooth.expand(-1, 3, -1), persistent=False)
        self.offset = config.ray_offset
        self._tracers: dict[torch.device, FirstHits] = {}
        self._fingerprint = _fingerprint(triangles)
        self.register_load_state_dict_post_hook(_accept_without_fingerprint)

    def get_extra_state(self) -> Float64[Tensor, " 10"]:
        """The fingerprint of the triangles, for a checkpoint."""
        return self._fingerprint

    def set_extra_state(self, state: Float64[Tensor, " 10"]) -> None:
        """Check the fingerprint in a checkpoint.

        Raises:
            UserError: the checkpoint was trained on another mesh.
        """
        if not torch.allclose(state.cpu(), self._fingerprint, rtol=SAME_MESH, atol=SAME_MESH):
            raise UserError(
                "the mesh is not the one that the run was trained on, or the scene frame has changed",
                "restore the file of the mesh and capture.json of the run, or train again",
            )

    # -------------------------------------------------------------------------------------- the host contract

    def render(self, rays: RayBatch) -> SurfaceHits:
        """First hit of each ray with R there; the background for a ray that misses."""
        with torch.no_grad():
            hit = self.intersect(rays)
        wo = -rays.directions[hit.rows]
        radiance = self.radiance_field(hit.position, wo, hit.normal, hit.position[:, :0])
        nothing, zeros = torch.zeros_like(rays.origins), torch.zeros_like(rays.origins[:, 0])
        return SurfaceHits(
            color=self._background(rays, hit.rows).to(radiance.dtype).index_put((hit.rows,), radiance),
            position=rays.origins.index_put((hit.rows,), hit.position),
            normal=nothing.index_put((hit.rows,), hit.normal),
            opacity=zeros.index_fill(0, hit.rows, 1.0),
            concentration=zeros.index_put((hit.rows,), hit.outside.to(zeros.dtype)),
        )

    @torch.no_grad()
    def scene_light(self, x: Float[Tensor, "N 3"], wi: Float[Tensor, "N S 3"]) -> SceneLight:
        """R where rays from x along wi hit the mesh; the inside of the mesh stops rays and is black."""
        directions = wi.reshape(-1, 3)
        origins = (x[:, None] + self.offset * wi).reshape(-1, 3)
        hit = self.intersect(RayBatch(origins, directions))
        radiance, distance = torch.zeros_like(directions), torch.full_like(directions[:, 0], torch.inf)
        distance[hit.rows] = (hit.position - x[hit.rows // wi.shape[1]]).norm(dim=-1)
        outside = torch.nonzero(hit.outside)[:, 0]
        for part in outside.split(RADIANCE_AT_ONCE):
            rows, position = hit.rows[part], hit.position[part]
            radiance[rows] = self.radiance_field(
                position, -directions[rows], hit.normal[part], position[:, :0]
            )
        distance = distance.view(wi.shape[:2])
        return SceneLight(distance.isfinite(), radiance.view(wi.shape), distance)

    def parameter_groups(self) -> Mapping[str, list[nn.Parameter]]:
        """The parameters of R and, if it is a field, of the background."""
        groups = {"radiance": list(self.radiance_field.parameters())}
        if self.background is not None:
            groups["background"] = list(self.background.parameters())
        return groups

    # ----------------------------------------------------------------------------------------------- geometry

    def intersect(self, rays: RayBatch) -> MeshHits:
        """First hits of rays with the mesh, on either side."""
        numbers = self._first_hits()(rays.origins, rays.directions)
        rows = torch.nonzero(numbers >= 0)[:, 0]
        numbers, origins, directions = numbers[rows], rays.origins[rows], rays.directions[rows]
        on_plane = intersect_planes(origins, directions, self.triangles[numbers].to(origins.dtype))
        flat = self.outward[numbers].to(origins.dtype)
        smooth = safe_normalize(
            (on_plane.weights[..., None] * self.corner_normals[numbers].to(origins.dtype)).sum(1)
        )
        return MeshHits(
            rows=rows,
            position=origins + on_plane.distance[:, None] * directions,
            normal=normals_towards_viewer(smooth, flat, directions),
            outside=(flat * directions).sum(-1) < 0.0,
        )

    def _first_hits(self) -> FirstHits:
        """The tracer of the current device, made at first use."""
        device = self.triangles.device
        if device not in self._tracers:
            self._tracers[device] = first_hits_of(self.triangles)
        return self._tracers[device]

    def _background(self, rays: RayBatch, hit_rows: Int[Tensor, " K"]) -> Float[Tensor, "N 3"]:
        """Radiance of the background for rays that miss; rows of other rays are not meaningful."""
        if self.background is None:
            return self.background_color.expand(len(rays), 3)
        missed = torch.nonzero(torch.ones_like(rays.origins[:, 0]).index_fill(0, hit_rows, 0.0))[:, 0]
        radiance = self.background(rays.origins[missed], rays.directions[missed])
        return radiance.new_zeros(len(rays), 3).index_put((missed,), radiance)


def _fingerprint(triangles: Float[Tensor, "F 3 3"]) -> Float64[Tensor, " 10"]:
    """The number of triangles, and the first and second moments of their corners, scene frame.

    A hash would also change with the rounding of another processor.
    """
    corner = triangles.double().reshape(-1, 3)
    second = (corner[:, [0, 1, 2, 0, 0, 1]] * corner[:, [0, 1, 2, 1, 2, 2]]).mean(0)
    return torch.cat((torch.tensor([float(len(triangles))]).double(), corner.mean(0), second))


def _accept_without_fingerprint(_: nn.Module, keys: Any) -> None:
    """Load checkpoints that were written before they had a fingerprint."""
    keys.missing_keys[:] = [key for key in keys.missing_keys if not key.endswith("_extra_state")]


def corner_normals(mesh: Mesh, outward: Float[Tensor, "F 3"]) -> Float[Tensor, "F 3 3"]:
    """Unit normals at the corners of faces, for interpolation within faces.

    The normal of a corner is the mean over the faces around its vertex that are connected to its face without
    crossing a sharp edge (`CREASE_ANGLE`). Faces are weighted by their angle at the vertex, so that the mean
    does not depend on the triangulation (Thürmer and Wüthrich 1998). Faces that do not share their vertices
    are not connected.

    Args:
        mesh: the triangles.
        outward: unit normals of the faces.
    """
    count, faces = 3 * len(mesh.faces), mesh.faces.numpy()
    shape = trimesh.Trimesh(mesh.vertices.numpy(), faces, process=False)
    pair, ends = shape.face_adjacency, shape.face_adjacency_edges
    first, second = outward.numpy()[pair].swapaxes(0, 1)
    smooth = (first * second).sum(-1) > math.cos(CREASE_ANGLE)
    pair, ends = pair[smooth], ends[smooth]
    # Corners at the same vertex, in two faces that share a smooth edge, belong to one group.
    slot = (faces[pair][:, :, None] == ends[:, None, :, None]).argmax(-1)
    corner = 3 * pair[..., None] + slot
    joined = coo_array(
        (np.ones(ends.size), (corner[:, 0].ravel(), corner[:, 1].ravel())), shape=(count, count)
    )
    number, group = connected_components(joined, directed=False)
    angle = torch.from_numpy(np.nan_to_num(shape.face_angles)).to(outward)
    turned = (angle[..., None] * outward[:, None]).view(-1, 3)
    around = outward.new_zeros(number, 3).index_add(0, torch.from_numpy(group).long(), turned)
    return safe_normalize(around, eps=TINY)[group].view(-1, 3, 3)
