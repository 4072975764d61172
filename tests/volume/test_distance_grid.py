"""Sphere tracing in a sampled distance field, compared with exact intersections."""

from __future__ import annotations

import math

import pytest
import torch
from torch.nn.functional import normalize

from neilfpp_method.volume import distance_grid
from neilfpp_method.volume.distance_grid import cell_size, look_up, sample_grid, trace_grid
from tests.scenes import sphere_distance

RADIUS = 1.5


def plate(x: torch.Tensor) -> torch.Tensor:
    """A plate two cells thick."""
    return (x.abs() - torch.tensor([0.8, 0.8, 0.03])).amax(-1)


def test_look_up_is_exact_for_a_linear_field():
    grid = sample_grid(lambda x: x @ torch.tensor([0.3, -0.5, 0.7]) + 0.1, RADIUS, 7, torch.zeros(1))
    x = (torch.rand(200, 3) * 2 - 1) * RADIUS
    torch.testing.assert_close(
        look_up(grid, RADIUS, x), x @ torch.tensor([0.3, -0.5, 0.7]) + 0.1, atol=1e-5, rtol=0.0
    )


def test_rays_hit_the_sphere_at_the_exact_points():
    torch.manual_seed(0)
    grid = sample_grid(sphere_distance, RADIUS, 96, torch.zeros(1))
    origins = 1.4 * normalize(torch.randn(2000, 3), dim=-1)
    directions = normalize(torch.rand(2000, 3) - 0.5 - origins, dim=-1)
    found = trace_grid(grid, RADIUS, origins, directions)
    along = (origins * directions).sum(-1)
    missed_by = (origins.square().sum(-1) - along**2).clamp_min(0).sqrt() - 0.6
    clear = missed_by.abs() > 2 * cell_size(
        grid, RADIUS
    )  # within one or two cells of a grazing ray both results are accepted
    assert torch.equal(found.hit[clear], missed_by[clear] < 0)
    hit = found.hit & clear
    exact = -along[hit] - (0.36 - (origins[hit].square().sum(-1) - along[hit] ** 2)).sqrt()
    assert (found.distance[hit] - exact).abs().quantile(0.99) < 2 * cell_size(grid, RADIUS)


def test_a_thin_plate_is_not_missed():
    torch.manual_seed(0)
    grid = sample_grid(plate, RADIUS, 96, torch.zeros(1))
    origins = torch.rand(2000, 3) * torch.tensor([1.2, 1.2, 0.0]) - torch.tensor([0.6, 0.6, -1.0])
    targets = torch.rand(2000, 3) * torch.tensor([1.2, 1.2, 0.0]) - torch.tensor([0.6, 0.6, 0.0])
    found = trace_grid(grid, RADIUS, origins, normalize(targets - origins, dim=-1))
    assert found.hit.all()


def test_a_ray_that_leaves_the_cube_hits_nothing():
    grid = sample_grid(sphere_distance, RADIUS, 32, torch.zeros(1))
    origins = torch.tensor([[0.0, 0.0, 0.9]]).expand(3, 3)
    found = trace_grid(grid, RADIUS, origins, torch.eye(3))
    assert not found.hit.any()


@pytest.mark.parametrize("leaves_surface", [False, True])
@pytest.mark.parametrize("threads", [1, 2])
@pytest.mark.parametrize("field", [sphere_distance, plate])
def test_compiled_loops_agree_with_the_reference(field, threads, leaves_surface, monkeypatch):
    torch.manual_seed(0)
    grid = sample_grid(field, RADIUS, 33, torch.zeros(1, dtype=torch.float64))
    origins = 3 * torch.rand(5000, 3, dtype=torch.float64) - 1.5
    directions = normalize(torch.randn(5000, 3, dtype=torch.float64), dim=-1)
    before = torch.get_num_threads()
    try:
        torch.set_num_threads(threads)
        found = trace_grid(grid, RADIUS, origins, directions, leaves_surface=leaves_surface)
    finally:
        torch.set_num_threads(before)
    monkeypatch.setattr(distance_grid, "ray_tracer", lambda device: None)
    expected = trace_grid(grid, RADIUS, origins, directions, leaves_surface=leaves_surface)
    assert found.hit.any()
    assert not found.hit.all()
    assert torch.equal(found.hit, expected.hit)
    torch.testing.assert_close(found.distance, expected.distance, atol=1e-9, rtol=0.0)


def test_invalid_rays_hit_nothing():
    grid = sample_grid(sphere_distance, RADIUS, 17, torch.zeros(1))
    broken = torch.tensor([[torch.nan, 0.0, 0.0], [torch.inf, 0.0, 0.0], [0.0, -torch.inf, torch.nan]])
    up = torch.tensor([[0.0, 0.0, 1.0]]).expand(3, 3)
    assert not trace_grid(grid, RADIUS, broken, up).hit.any()
    assert not trace_grid(grid, RADIUS, up, broken).hit.any()


def ball_above_floor(x: torch.Tensor) -> torch.Tensor:
    """A ball of radius 0.3 whose lowest point is 0.2 above the floor z = 0."""
    return torch.minimum(x[:, 2], (x - torch.tensor([0.0, 0.0, 0.5])).norm(dim=-1) - 0.3)


@pytest.mark.parametrize("angle_deg", [0.0, 30.0, 60.0])
def test_a_shadow_lies_where_it_belongs(angle_deg):
    """Rays that start above the floor, along its normal, shift the shadow by the height times tan θ."""
    grid = sample_grid(ball_above_floor, RADIUS, 96, torch.zeros(1))
    steps = torch.linspace(-1.2, 1.2, 161)
    floor = torch.stack([*torch.meshgrid(steps, steps, indexing="ij"), torch.zeros(161, 161)], -1).view(-1, 3)
    angle = math.radians(angle_deg)
    sun = torch.tensor([math.sin(angle), 0.0, math.cos(angle)])
    is_dark = trace_grid(grid, RADIUS, floor, sun.expand_as(floor), leaves_surface=True).hit
    to_ball = torch.tensor([0.0, 0.0, 0.5]) - floor
    should_be_dark = torch.linalg.cross(to_ball, sun.expand_as(floor)).norm(dim=-1) < 0.3
    shift = floor[is_dark].mean(0) - floor[should_be_dark].mean(0)
    assert shift.norm() < 0.3 * cell_size(grid, RADIUS)
    # A ray hits a quarter of a cell before a surface, so that shadows are larger by as much.
    assert (is_dark & ~should_be_dark).float().mean() < 0.02
    assert not (should_be_dark & ~is_dark).any()


@pytest.mark.parametrize("height", [-0.75, 0.0, 0.2])
def test_a_ray_does_not_hit_the_surface_that_it_leaves(height):
    """Heights in cells: hits of a host and the surface of its grid differ a little."""
    torch.manual_seed(0)
    grid = sample_grid(lambda x: x[:, 2], RADIUS, 96, torch.zeros(1))
    start = torch.rand(2000, 3) - torch.tensor([0.5, 0.5, 0.0])
    start[:, 2] = height * cell_size(grid, RADIUS)
    up = normalize(torch.randn(2000, 3), dim=-1)
    up[:, 2] = up[:, 2].abs().clamp_min(0.02)
    assert not trace_grid(grid, RADIUS, start, normalize(up, dim=-1), leaves_surface=True).hit.any()


@pytest.mark.parametrize("distance", [0.1, 0.5, 2.0])
def test_a_ray_hits_the_wall_next_to_its_start(distance):
    """Distances of the wall in cells."""
    grid = sample_grid(lambda x: torch.minimum(x[:, 2], 0.5 - x[:, 0]), RADIUS, 96, torch.zeros(1))
    start = torch.tensor([[0.5 - distance * cell_size(grid, RADIUS), 0.0, 0.0]])
    for tilt in (0.3, 1.0, 3.0):
        towards = normalize(torch.tensor([[1.0, 0.0, tilt]]), dim=-1)
        assert trace_grid(grid, RADIUS, start, towards, leaves_surface=True).hit.all()
        assert not trace_grid(
            grid, RADIUS, start, towards * torch.tensor([-1.0, 1, 1]), leaves_surface=True
        ).hit.any()
