"""Lines of sight: which points of a cloud a camera sees, on a ball and behind a wall."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from torch.nn.functional import normalize

from neilfpp_method.data.sight_lines import MARGIN, find_sight_lines, visible_points
from neilfpp_method.data.views import Camera
from neilfpp_method.structures import OrientedPoints

DISTANCE = 3.0
"""From the camera, which stands on −z and looks along +z, to the origin, scene units."""


@pytest.fixture
def camera() -> Camera:
    pose = np.eye(4)
    pose[2, 3] = DISTANCE
    return Camera(fx=200.0, fy=200.0, cx=100.0, cy=100.0, width=200, height=200, w2c=pose)


def ball(radius: float, count: int = 4000) -> OrientedPoints:
    normal = normalize(torch.randn(count, 3, generator=torch.Generator().manual_seed(0)), dim=-1)
    return OrientedPoints(radius * normal, normal)


def square(z: float, half: float, count: int = 4000) -> OrientedPoints:
    """Points on a square across the axis at z, turned towards the camera."""
    flat = (2 * torch.rand(count, 2, generator=torch.Generator().manual_seed(1)) - 1) * half
    position = torch.cat((flat, torch.full((count, 1), z)), -1)
    return OrientedPoints(position, torch.tensor([[0.0, 0.0, -1.0]]).expand(count, 3))


def test_the_near_side_of_a_ball_is_visible(camera):
    points = ball(0.5)
    visible = visible_points(camera, points, spacing=0.02)
    to_camera = torch.tensor([0.0, 0.0, -DISTANCE]) - points.position
    cosine = (normalize(to_camera, dim=-1) * points.normal).sum(-1)
    assert visible[cosine > 0.5].float().mean() > 0.95
    assert not visible[cosine < 0.25].any()


def test_what_stands_behind_a_wall_is_not_visible(camera):
    wall, behind, beside = square(0.0, 0.5), square(1.0, 0.3), square(1.0, 0.2)
    beside = OrientedPoints(beside.position + torch.tensor([1.2, 0.0, 0.0]), beside.normal)
    together = OrientedPoints(
        torch.cat([part.position for part in (wall, behind, beside)]),
        torch.cat([part.normal for part in (wall, behind, beside)]),
    )
    visible = visible_points(camera, together, spacing=0.01).view(3, -1)
    assert visible[0].all()
    assert not visible[1].any()
    assert visible[2].all()


def test_lines_run_from_the_camera_to_short_of_the_points(camera):
    lines = find_sight_lines([camera], ball(0.5))
    assert len(lines) > 500
    torch.testing.assert_close(lines.start, torch.tensor([[0.0, 0.0, -DISTANCE]]).expand_as(lines.start))
    # The near side of the ball, which no line enters.
    assert lines.end[:, 2].max() < 0
    assert lines.end.norm(dim=-1).min() > 0.5
    assert lines.end.norm(dim=-1).max() < 0.5 + MARGIN + 1e-4


def test_a_cloud_that_no_camera_sees_has_no_lines(camera):
    behind = square(-5.0, 0.5)
    assert len(find_sight_lines([camera], behind)) == 0
    assert len(find_sight_lines([camera], behind[:1])) == 0
