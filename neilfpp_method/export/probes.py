"""Light probes: all light that arrives at surface points, unrolled; at points where it differs."""

from __future__ import annotations

from collections.abc import Iterator

import torch
from jaxtyping import Float, Int
from torch import Tensor

from neilfpp_method.data.views import camera_rays
from neilfpp_method.errors import UserError
from neilfpp_method.fields.direction_map import map_directions
from neilfpp_method.structures import OrientedPoints
from neilfpp_method.train.run import Run

__all__ = ["probe", "spread", "spread_over_surface"]

CANDIDATES = 4096
"""Surface points that the training views are asked for; the spread ones are chosen from them."""
PAIRS_AT_ONCE = 2**16
"""Pairs of a point and a direction that the light is asked for together: what bounds the memory."""


@torch.no_grad()
def spread_over_surface(run: Run, count: int) -> OrientedPoints:
    """Up to `count` points of what the training views see, chosen by `spread`; the same ones every time.

    Raises:
        UserError: no training view sees a surface.
    """
    device = next(run.model.parameters()).device
    seen = list(_seen(run, device))
    points = OrientedPoints(
        torch.cat([part.position for part in seen]), torch.cat([part.normal for part in seen])
    )
    if not len(points):
        raise UserError(f"{run.path}: no training view sees a surface", "train the run for longer")
    return points[spread(points, count)]


@torch.no_grad()
def spread(points: OrientedPoints, count: int) -> Int[Tensor, " N"]:
    """Rows of up to `count` points by farthest-point sampling, the first the farthest from their mean.

    What arrives depends on the place and on which way the surface faces, so both count, in scene units and by
    the normal: else the corners of a floor come before anything that stands on it.
    """
    place = torch.cat((points.position, points.normal), -1)
    rows = [int((place - place.mean(0)).square().sum(-1).argmax())]
    nearest = torch.full_like(place[:, 0], torch.inf)
    for _ in range(min(count, len(place)) - 1):
        nearest = torch.minimum(nearest, (place - place[rows[-1]]).square().sum(-1))
        rows.append(int(nearest.argmax()))
    return torch.tensor(rows, device=place.device)


@torch.no_grad()
def probe(
    run: Run, position: Float[Tensor, " 3"], normal: Float[Tensor, " 3"], height: int
) -> Float[Tensor, "height width 3"]:
    """Linear radiance that arrives at a surface point, laid out as environment maps; 0 below the surface."""
    directions = map_directions(height, 2 * height).to(position)
    radiance = torch.zeros_like(directions)
    above = directions @ normal > 0
    parts = directions[above].split(PAIRS_AT_ONCE)
    radiance[above] = torch.cat([run.model.incident_light(position[None], part[None])[0] for part in parts])
    return radiance


def _seen(run: Run, device: torch.device) -> Iterator[OrientedPoints]:
    """Positions and normals where random pixels of each training view meet one surface."""
    views = run.capture.train_views
    generator = torch.Generator().manual_seed(0)
    for view in views:
        rays = camera_rays(run.capture.normalisation.camera(view.camera))
        some = torch.randperm(len(rays), generator=generator)[: -(-CANDIDATES // len(views))]
        hits = run.model.host.render(rays[some].to(device))
        met = hits.is_hit(run.config.shading.hit_share)
        yield OrientedPoints(hits.position[met], hits.normal[met])
