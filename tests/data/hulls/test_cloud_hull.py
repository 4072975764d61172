"""The hull of a point cloud compared with the ball or wall that its points lie on."""

from __future__ import annotations

import itertools

import pytest
import torch

from neilfpp_method.data.hulls import cloud_hull
from neilfpp_method.data.hulls.cloud_hull import find_cloud_hull
from neilfpp_method.structures import OrientedPoints
from tests.data.hulls.test_visual_hull import BALL, SIZE, camera_at, ring

RADIUS = 1.75
RESOLUTION = 64
CELL = 2 * RADIUS / RESOLUTION


def ball(count: int = 20_000) -> OrientedPoints:
    """Points on a ball about the origin."""
    normal = torch.nn.functional.normalize(
        torch.randn(count, 3, generator=torch.Generator().manual_seed(0)), dim=-1
    )
    return OrientedPoints(BALL * normal, normal)


def cameras(count: int = 12):
    return [outline.view.camera for outline in ring(count)]


def wall() -> OrientedPoints:
    """Points on the square |x|, |z| < 0.6 of the plane y = 0, which face −y."""
    square = 1.2 * torch.rand(20_000, 2, generator=torch.Generator().manual_seed(0)) - 0.6
    position = torch.stack([square[:, 0], torch.zeros(len(square)), square[:, 1]], -1)
    return OrientedPoints(position, torch.tensor([0.0, -1.0, 0.0]).expand_as(position))


def test_the_hull_of_a_ball_is_the_ball():
    hull = find_cloud_hull(ball(), cameras(24), RADIUS, RESOLUTION)
    x = RADIUS * (2 * torch.rand(8000, 3, generator=torch.Generator().manual_seed(1)) - 1)
    x = x[x.norm(dim=-1) < RADIUS]
    # Points cover their neighbours, so the hull is wider than the ball by up to 2½ pixels and a cell.
    pixel = 4.0 / 180 * 120 / cloud_hull.DEPTH_SIDE
    error = hull.at(x) - (x.norm(dim=-1) - BALL)
    assert -2.5 * pixel - CELL < error.mean() < 0
    assert (error < 0.5 * CELL).float().mean() > 0.98
    assert (hull.at(ball().position) < 0.5 * CELL).all(), "the hull contains the points"
    assert hull.at(torch.zeros(1, 3)) < -0.4


def test_gaps_between_points_of_an_object_do_not_open_it():
    """A ball of 600 points in front of a dense wall: cameras see points of the wall through its gaps."""
    sparse, behind = ball(600), wall()
    behind = OrientedPoints(2 * behind.position + torch.tensor([0.0, 1.0, 0.0]), behind.normal)
    both = OrientedPoints(
        torch.cat([sparse.position, behind.position]), torch.cat([sparse.normal, behind.normal])
    )
    front = [camera_at((x, -4.0, z)) for x in (-1.0, 0.0, 1.0) for z in (-0.8, 0.8)]
    hull = find_cloud_hull(both, front, RADIUS, RESOLUTION)
    assert hull.at(torch.zeros(1, 3)) < 0


def test_space_that_no_point_hides_is_empty():
    """A wall seen from one side: solid behind it, empty in front and above it."""
    front = [camera_at((x, -4.0, z)) for x in (-1.0, 0.0, 1.0) for z in (-0.8, 0.8)]
    hull = find_cloud_hull(wall(), front, RADIUS, RESOLUTION)
    behind, before, above = hull.at(torch.tensor([[0.0, 0.4, 0.0], [0.0, -0.5, 0.0], [0.0, 0.4, 1.4]]))
    assert behind < -0.2
    assert before > 0.2
    assert above > 0.2


def test_the_hull_of_a_room_is_what_is_behind_its_walls():
    """Cameras inside of a ball look away from each other, so that each of them shows a part of it."""
    walls = ball()
    room = OrientedPoints(walls.position, -walls.normal)
    directions = torch.tensor(list(itertools.product((-1.0, 0.0, 1.0), repeat=3)))
    directions = torch.nn.functional.normalize(directions[directions.any(-1)], dim=-1)
    inside = [camera_at((-0.2 * direction).tolist(), focal=0.5 * SIZE) for direction in directions]
    hull = find_cloud_hull(room, inside, RADIUS, RESOLUTION)
    behind = 1.4 * directions
    assert (hull.at(behind) < 0).all()
    assert hull.at(torch.zeros(1, 3)) > 0.25
    # In front of a point the hull begins 1½ cells and the width of a pixel earlier.
    assert hull.at(walls.position).abs().median() < 2.5 * CELL


def test_false_points_in_empty_space_are_removed():
    """One in fifty points floats in front of the ball, and the other cameras see through it."""
    true = ball()
    generator = torch.Generator().manual_seed(2)
    away = torch.nn.functional.normalize(torch.randn(40, 3, generator=generator), dim=-1)
    noisy = OrientedPoints(torch.cat([true.position, 1.2 * away]), torch.cat([true.normal, away]))
    hull = find_cloud_hull(noisy, cameras(24), RADIUS, RESOLUTION)
    assert (hull.at(1.2 * away) > 0).float().mean() > 0.9


@pytest.mark.parametrize("position", [torch.zeros(0, 3), torch.full((10, 3), 100.0)])
def test_points_that_hide_nothing_have_no_hull(position):
    points = OrientedPoints(position, torch.nn.functional.normalize(torch.ones_like(position), dim=-1))
    hull = find_cloud_hull(points, cameras(), RADIUS, RESOLUTION)
    assert hull == "the point cloud hides almost nothing from the cameras"


@pytest.mark.parametrize("factor", [-1.0, float("nan")])
def test_normals_that_point_inwards_or_nowhere_give_no_hull(factor):
    points = OrientedPoints(ball().position, factor * ball().normal)
    assert isinstance(find_cloud_hull(points, cameras(24), RADIUS, RESOLUTION), str)


def test_a_point_hides_only_what_its_front_faces():
    """Points seen from behind belong to the other side of an object, so they limit nothing."""
    points = ball()
    inside_out = OrientedPoints(points.position, -points.normal)
    outside = cloud_hull._depth_map(camera_at((0.0, -4.0, 0.0)), points)
    inside = cloud_hull._depth_map(camera_at((0.0, -4.0, 0.0)), inside_out)
    middle = tuple(side // 2 for side in outside.shape)
    assert outside[middle] == pytest.approx(4 - BALL, abs=0.02)
    assert inside[middle] == pytest.approx(4 + BALL, abs=0.06)
    assert outside[0, 0].isinf()
