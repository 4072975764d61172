"""Sphere tracing in a sampled distance field, compared with exact intersections."""

from __future__ import annotations

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


@pytest.mark.parametrize("threads", [1, 2])
@pytest.mark.parametrize("field", [sphere_distance, plate])
def test_compiled_loops_agree_with_the_reference(field, threads, monkeypatch):
    torch.manual_seed(0)
    grid = sample_grid(field, RADIUS, 33, torch.zeros(1, dtype=torch.float64))
    origins = 3 * torch.rand(5000, 3, dtype=torch.float64) - 1.5
    directions = normalize(torch.randn(5000, 3, dtype=torch.float64), dim=-1)
    before = torch.get_num_threads()
    try:
        torch.set_num_threads(threads)
        found = trace_grid(grid, RADIUS, origins, directions)
    finally:
        torch.set_num_threads(before)
    monkeypatch.setattr(distance_grid, "ray_tracer", lambda device: None)
    expected = trace_grid(grid, RADIUS, origins, directions)
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
