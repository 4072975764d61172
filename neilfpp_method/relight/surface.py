"""The surface of the path tracer: triangles with corner normals, and ray intersection."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from neilfpp_method.hosts.mesh_tracing import (
    face_normals,
    first_hits_of,
    intersect_planes,
    normals_towards_viewer,
)
from neilfpp_method.shading.frame import safe_normalize
from neilfpp_method.structures import Indexable

__all__ = ["OFFSET", "Intersections", "Surface"]

OFFSET = 1e-4
"""Height above a triangle at which rays start, scene units. It is larger than rounding errors (1e-6) and
smaller than details of the surface.
"""


@dataclass(frozen=True)
class Intersections(Indexable):
    """First hits of the K rays that hit the surface.

    Attributes:
        rows: indices of the rays.
        distance: distance along the ray, scene units.
        position: position of the hit, scene frame.
        normal: unit shading normal: the interpolated normal if it faces the ray, else `flat`.
        flat: unit normal of the triangle.
        outside: whether the ray hits the outside of the triangle.
    """

    rows: Int[Tensor, " K"]
    distance: Float[Tensor, " K"]
    position: Float[Tensor, "K 3"]
    normal: Float[Tensor, "K 3"]
    flat: Float[Tensor, "K 3"]
    outside: Bool[Tensor, " K"]


class Surface:
    """Triangles in the scene frame, oriented outwards. Their inside absorbs rays and reflects no light.

    First hits are found by Embree on a CPU, if it is installed, and else by a bounding volume hierarchy.

    Args:
        triangles: corners of the triangles.
        corner_normals: unit shading normals at the corners; None for the normals of the triangles.
    """

    def __init__(
        self, triangles: Float[Tensor, "F 3 3"], corner_normals: Float[Tensor, "F 3 3"] | None = None
    ) -> None:
        self.triangles = triangles
        self.outward = face_normals(triangles)
        self.corner_normals = (
            self.outward[:, None].expand(-1, 3, -1) if corner_normals is None else corner_normals
        )
        self._first_hits = first_hits_of(triangles)

    def intersect(self, origins: Float[Tensor, "N 3"], directions: Float[Tensor, "N 3"]) -> Intersections:
        """Find the first hits of rays with unit directions."""
        numbers = self._first_hits(origins, directions)
        rows = torch.nonzero(numbers >= 0)[:, 0]
        numbers, origins, directions = numbers[rows], origins[rows], directions[rows]
        hit = intersect_planes(origins, directions, self.triangles[numbers])
        flat = self.outward[numbers]
        # Barycentric weights are NaN if a ray lies in the plane of its triangle.
        weights = hit.weights.nan_to_num(1 / 3)[..., None]
        smooth = safe_normalize((weights * self.corner_normals[numbers]).sum(1))
        distance = hit.distance.nan_to_num(0.0, 0.0, 0.0)
        return Intersections(
            rows=rows,
            distance=distance,
            position=origins + distance[:, None] * directions,
            normal=normals_towards_viewer(smooth, flat, directions),
            flat=flat,
            outside=(flat * directions).sum(-1) < 0,
        )

    def blocked(
        self,
        origins: Float[Tensor, "N 3"],
        directions: Float[Tensor, "N 3"],
        before: Float[Tensor, " N"] | None = None,
    ) -> Bool[Tensor, " N"]:
        """Whether rays hit the surface; if `before` is given, whether they hit it at a smaller distance."""
        numbers = self._first_hits(origins, directions)
        hit = numbers >= 0
        if before is None:
            return hit
        rows = torch.nonzero(hit)[:, 0]
        distance = intersect_planes(origins[rows], directions[rows], self.triangles[numbers[rows]]).distance
        return hit.index_put((rows,), distance < before[rows])
