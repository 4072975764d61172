"""Points fused to distances, compared with the distance from a sphere."""

from __future__ import annotations

import torch
from torch.nn.functional import normalize

from neilfpp_method.volume.distance_grid import cell_size, look_up, trace_grid
from neilfpp_method.volume.fusion import fuse_surface, grid_normal, mean_at

R, CELLS, BALL = 1.0, 48, 0.6


def sphere(count: int = 20_000):
    normal = normalize(torch.randn(count, 3, generator=torch.Generator().manual_seed(0)), dim=-1)
    return fuse_surface(BALL * normal, normal, normal.abs(), R, CELLS), normal


def test_distances_are_accurate_near_the_surface_and_lower_bounds_elsewhere():
    surface, normal = sphere()
    edge = cell_size(surface.distance, R)
    for height in (0.0, 0.5, 1.0):
        found = look_up(surface.distance, R, (BALL + height * edge) * normal[:500])
        assert (found - height * edge).abs().max() < 0.15 * edge
    for height in (4.0, 8.0):
        found = look_up(surface.distance, R, (BALL + height * edge) * normal[:500])
        assert (found > 0.3 * height * edge).all()
        assert (found < height * edge).all()
    assert (look_up(surface.distance, R, torch.zeros(1, 3)) > 0).all()  # no point shows the inside


def test_normals_and_means_are_those_of_the_points():
    surface, normal = sphere()
    x = BALL * normal[:500]
    assert (grid_normal(surface.distance, R, x) * normal[:500]).sum(-1).min() > 0.98
    assert (mean_at(surface, R, x) - normal[:500].abs()).abs().max() < 0.1
    assert not mean_at(surface, R, torch.zeros(1, 3)).any()


def test_rays_hit_the_fused_surface():
    surface, _ = sphere()
    towards = normalize(torch.randn(500, 3, generator=torch.Generator().manual_seed(1)), dim=-1)
    found = trace_grid(surface.distance, R, -0.95 * towards, towards)
    assert found.hit.all()
    assert (found.distance - 0.35).abs().max() < 0.5 * cell_size(surface.distance, R)


def test_no_points_give_an_empty_grid():
    nothing = fuse_surface(torch.zeros(0, 3), torch.zeros(0, 3), torch.zeros(0, 3), R, 8)
    assert (nothing.distance > 0).all()
    assert not trace_grid(nothing.distance, R, torch.zeros(1, 3), torch.eye(3)[:1]).hit.any()
    outside = fuse_surface(torch.full((4, 3), 5.0), torch.eye(3)[[0, 1, 2, 0]], torch.zeros(4, 3), R, 8)
    assert torch.equal(outside.distance, nothing.distance)
