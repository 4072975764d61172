"""The surface that paths bounce on: triangles with normals at their corners, and what rays meet first."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from neilfpp_method.hosts.mesh_tracing import build_tree, embree_tracer, meet, tree_tracer
from neilfpp_method.shading.frame import safe_normalize
from neilfpp_method.structures import Indexable

__all__ = ["OFFSET", "Crossings", "Surface"]

OFFSET = 1e-4
"""Height above a triangle at which rays leave, scene units: above rounding (1e-6), below relief."""
TINY = 1e-18
"""Length under which a sum of edge products has no direction."""


@dataclass(frozen=True)
class Crossings(Indexable):
    """The rays that meet the surface: which they are, where, and the surface there.

    `normal` is for shading, interpolated where that faces the ray; `flat` is the triangle's own; `outside` is
    false where a ray comes from within.
    """

    rows: Int[Tensor, " K"]
    distance: Float[Tensor, " K"]
    position: Float[Tensor, "K 3"]
    normal: Float[Tensor, "K 3"]
    flat: Float[Tensor, "K 3"]
    outside: Bool[Tensor, " K"]


class Surface:
    """Triangles in the scene frame, wound outwards: from within they stop rays and send nothing.

    Args:
        triangles: their corners.
        corner_normals: unit normals for shading at the corners; none: flat ones.

    Embree finds first hits on a CPU, a tree of boxes anywhere else.
    """

    def __init__(
        self, triangles: Float[Tensor, "F 3 3"], corner_normals: Float[Tensor, "F 3 3"] | None = None
    ) -> None:
        across = torch.linalg.cross(triangles[:, 1] - triangles[:, 0], triangles[:, 2] - triangles[:, 0])
        self.triangles = triangles
        self.outward = safe_normalize(across, eps=TINY)
        self.corner_normals = (
            self.outward[:, None].expand(-1, 3, -1) if corner_normals is None else corner_normals
        )
        tracer = embree_tracer(triangles) if triangles.device.type == "cpu" else None
        self._first_hits = tracer or tree_tracer(build_tree(triangles))

    def cross(self, origins: Float[Tensor, "N 3"], directions: Float[Tensor, "N 3"]) -> Crossings:
        """Where rays of unit directions meet the surface first."""
        numbers = self._first_hits(origins, directions)
        rows = torch.nonzero(numbers >= 0)[:, 0]
        numbers, origins, directions = numbers[rows], origins[rows], directions[rows]
        meeting = meet(origins, directions, self.triangles[numbers])
        flat = self.outward[numbers]
        weights = meeting.weights.nan_to_num(1 / 3)[..., None]  # a ray along its triangle
        smooth = safe_normalize((weights * self.corner_normals[numbers]).sum(1))
        faces_viewer = (smooth * directions).sum(-1, keepdim=True) < 0
        distance = meeting.distance.nan_to_num(0.0, 0.0, 0.0)
        return Crossings(
            rows=rows,
            distance=distance,
            position=origins + distance[:, None] * directions,
            normal=torch.where(faces_viewer, smooth, flat),
            flat=flat,
            outside=(flat * directions).sum(-1) < 0,
        )

    def blocked(
        self,
        origins: Float[Tensor, "N 3"],
        directions: Float[Tensor, "N 3"],
        before: Float[Tensor, " N"] | None = None,
    ) -> Bool[Tensor, " N"]:
        """Whether rays meet the surface at all, or nearer than a distance."""
        numbers = self._first_hits(origins, directions)
        hit = numbers >= 0
        if before is None:
            return hit
        rows = torch.nonzero(hit)[:, 0]
        distance = meet(origins[rows], directions[rows], self.triangles[numbers[rows]]).distance
        return hit.index_put((rows,), distance < before[rows])
