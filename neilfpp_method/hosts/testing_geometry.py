"""Checks that a surface is the same from other viewpoints: from the side, from afar, from close by.

They detect wrong depths, wrong normals, and rays that miss a surface that they should hit.
"""

from __future__ import annotations

import torch
from torch import Tensor
from torch.nn.functional import normalize

from neilfpp_method.hosts.other_viewpoints import (
    SAME_POINT,
    START_DISTANCE,
    OtherViewpoints,
    other_viewpoints,
)
from neilfpp_method.hosts.outputs import MAX_MEDIAN_DISTANCE
from neilfpp_method.hosts.testing_case import HIT_SHARE, Case
from neilfpp_method.structures import OrientedPoints, RayBatch

__all__ = ["GEOMETRY_CHECKS"]

MIN_AGREEMENT = 0.6
"""Smallest share of points that agree in both views. The others may be occluded or on a silhouette."""
RAY_SPACING = 0.01
"""Distance between neighbouring rays, scene units."""
MAX_SLOPE = 8.0
"""Neighbouring hits that are further apart than this multiple of their rays' distance lie on two surfaces."""
MAX_ANGLE = 10.0
"""Largest median angle between normals and the surface through neighbouring hits, degrees."""


def _in_unit_sphere(case: Case) -> None:
    reach = case.hits.position.detach()[case.hit].norm(dim=-1).median().item()
    broken = f"half of its hits are {reach:.3g} or more from the origin: scale the scene into the unit sphere"
    case.require(reach < MAX_MEDIAN_DISTANCE, broken)


def _another_view(case: Case) -> None:
    others = _other_viewpoints(case)
    rays = others.rays(others.distance)
    _require_same_hits(case, others.position, rays, "another view", "is the depth a distance along the ray?")


def _from_afar(case: Case) -> None:
    position, back = case.hits.position.detach()[case.hit], -case.rays.directions[case.hit]
    distance = (position - case.rays.origins[case.hit]).norm(dim=-1)
    rays = RayBatch(position + 2 * distance[:, None] * back, -back)
    _require_same_hits(case, position, rays, "twice the distance", "a far plane?")


def _from_close_by(case: Case) -> None:
    others = _other_viewpoints(case)
    rays = others.rays(torch.full_like(others.distance, START_DISTANCE))
    suspect = "light between surfaces would not see it (a near plane?)"
    _require_same_hits(case, others.position, rays, f"{START_DISTANCE} away", suspect)


def _normals_of_neighbors(case: Case) -> None:
    """Compare normals with cross products of differences between the hits of four neighbouring rays."""
    d = case.rays.directions[case.hit]
    side = normalize(torch.linalg.cross(d, d.roll(1, dims=-1) + torch.tensor([0.3, 0.1, -0.2]).to(d)), dim=-1)
    up = torch.linalg.cross(d, side)
    origins = case.rays.origins[case.hit]
    neighbors = [
        case.constants(RayBatch(origins + sign * RAY_SPACING * axis, d))
        for axis in (side, up)
        for sign in (1, -1)
    ]
    across, along = (a.position - b.position for a, b in (neighbors[:2], neighbors[2:]))
    hit_by_all = torch.stack([f.is_hit(HIT_SHARE) for f in neighbors]).all(0)
    near = torch.stack([across.norm(dim=-1), along.norm(dim=-1)]).amax(0) < 2 * MAX_SLOPE * RAY_SPACING
    rows = hit_by_all & near
    if rows.sum() < 8:
        # The surface is too small or too rough for a decision.
        return
    implied = normalize(torch.linalg.cross(across, along), dim=-1)[rows]
    normal = case.hits.normal.detach()[case.hit][rows]
    angle = (implied * normal).sum(-1).abs().clamp_max(1.0).acos().rad2deg().median().item()
    broken = f"half of its normals differ by {angle:.0f}° or more from the surface through neighbouring hits"
    case.require(angle < MAX_ANGLE, f"{broken}: take the gradient of the field that is rendered")


def _other_viewpoints(case: Case) -> OtherViewpoints:
    position, normal = case.hits.position.detach()[case.hit], case.hits.normal.detach()[case.hit]
    return other_viewpoints(case.rays[torch.nonzero(case.hit)[:, 0]], OrientedPoints(position, normal))


def _require_same_hits(case: Case, position: Tensor, rays: RayBatch, viewpoint: str, suspect: str) -> None:
    """Require that most rays hit the positions to which they lead.

    Twice the width of a soft surface is added to the distance that counts as the same point.

    Args:
        case: the host under test.
        position: surface points that are known from the first view.
        rays: rays to these points from another viewpoint.
        viewpoint: description of that viewpoint.
        suspect: the end of the message: the probable cause, or the consequence.
    """
    again = case.constants(rays)
    offset = (again.position - position).norm(dim=-1)
    largest = SAME_POINT + 2 * case.width
    same = (again.is_hit(HIT_SHARE) & (offset <= largest)).float().mean().item()
    lost = f"{1 - same:.0%} of its hits have another position when seen from {viewpoint}"
    case.require(same >= MIN_AGREEMENT, f"{lost}: {suspect}")


GEOMETRY_CHECKS = (_in_unit_sphere, _another_view, _from_afar, _from_close_by, _normals_of_neighbors)
