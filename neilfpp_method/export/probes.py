"""Light probes: incident radiance at surface points as latitude-longitude images."""

from __future__ import annotations

from collections.abc import Iterator

import torch
from jaxtyping import Float, Int
from torch import Tensor

from neilfpp_method.data.cameras.projection import camera_rays
from neilfpp_method.errors import UserError
from neilfpp_method.fields.direction_map import map_directions
from neilfpp_method.structures import OrientedPoints
from neilfpp_method.train.run import Run

__all__ = ["probe", "spread", "spread_over_surface"]

CANDIDATES = 4096
"""Number of surface points in the training views from which the probes are chosen."""
DIRECTIONS_AT_ONCE = 2**16
"""Number of directions per evaluation of the light, which bounds the memory."""


@torch.no_grad()
def spread_over_surface(run: Run, count: int) -> OrientedPoints:
    """Choose up to `count` surface points that training views see, by `spread`. Deterministic.

    Raises:
        UserError: no training view sees a surface.
    """
    points = OrientedPoints.joined(list(_visible_points(run)))
    if not len(points):
        raise UserError(f"{run.path}: no training view sees a surface", "train the run for longer")
    return points[spread(points, count)]


@torch.no_grad()
def spread(points: OrientedPoints, count: int) -> Int[Tensor, " N"]:
    """Choose up to `count` points by farthest-point sampling, starting with the farthest from their mean.

    Distances are measured in position (scene units) and normal together, because the incident light depends
    on both. With positions only, the corners of a floor would be chosen before the objects that stand on it.

    Returns:
        Row indices of the points.
    """
    coordinates = torch.cat((points.position, points.normal), -1)
    rows = [int((coordinates - coordinates.mean(0)).square().sum(-1).argmax())]
    nearest = torch.full_like(coordinates[:, 0], torch.inf)
    for _ in range(min(count, len(coordinates)) - 1):
        nearest = torch.minimum(nearest, (coordinates - coordinates[rows[-1]]).square().sum(-1))
        rows.append(int(nearest.argmax()))
    return torch.tensor(rows, device=coordinates.device)


@torch.no_grad()
def probe(
    run: Run, position: Float[Tensor, " 3"], normal: Float[Tensor, " 3"], height: int
) -> Float[Tensor, "height width 3"]:
    """Incident linear radiance at a surface point, in the layout of environment maps; 0 below the surface."""
    directions = map_directions(height, 2 * height).to(position)
    radiance = torch.zeros_like(directions)
    above = directions @ normal > 0
    parts = directions[above].split(DIRECTIONS_AT_ONCE)
    radiance[above] = torch.cat([run.model.incident_light(position[None], part[None])[0] for part in parts])
    return radiance


def _visible_points(run: Run) -> Iterator[OrientedPoints]:
    """Surface points at random pixels of each training view."""
    views = run.capture.train_views
    generator = torch.Generator().manual_seed(0)
    for view in views:
        rays = camera_rays(run.capture.scene_camera(view))
        pixels = torch.randperm(len(rays), generator=generator)[: -(-CANDIDATES // len(views))]
        hits = run.model.host.render(rays[pixels].to(run.device))
        is_hit = hits.is_hit(run.config.shading.hit_share)
        yield OrientedPoints(hits.position[is_hit], hits.normal[is_hit])
