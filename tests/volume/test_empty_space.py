"""Skipped space, compared with quadrature of the true density: skipped parts neither absorb nor are
visible.
"""

from __future__ import annotations

import math

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from torch.nn.functional import normalize

from neilfpp_method.structures import RayBatch
from neilfpp_method.volume import empty_space
from neilfpp_method.volume.compositing import depth_weights
from neilfpp_method.volume.density import entering_depth, laplace_density, laplace_depth
from neilfpp_method.volume.distance_grid import cell_size
from neilfpp_method.volume.empty_space import EmptySpace
from neilfpp_method.volume.intersect import sphere_interval
from neilfpp_method.volume.partition import SampleCounts
from neilfpp_method.volume.samplers import error_bounded_samples
from tests.scenes import sphere_distance

RADIUS = 1.75
COUNTS = SampleCounts(cuts=128, rounds=5, rendered=64)
CELL = 2 * RADIUS / (empty_space.RESOLUTION - 1)


def hollow(x):
    """The inner side of a thin shell, on the side of the camera: a room viewed from within."""
    return 0.01 - (x.norm(dim=-1) - 1.2).abs()


def plate(thickness, tilt=0.3, offset=0.1):
    """An infinite plate that is thinner than a cell if `thickness` is."""
    normal = torch.tensor([math.sin(tilt), 0.2, math.cos(tilt)]) / math.sqrt(1.04)
    return lambda x: (x @ normal - offset).abs() - thickness / 2


def bundle(count=200, seed=0, inside=False):
    """Rays towards the centre of the scene from outside, or in all directions from within."""
    generator = torch.Generator().manual_seed(seed)
    origins = normalize(torch.randn(count, 3, generator=generator), dim=-1) * (0.9 if inside else 2.5)
    targets = torch.randn(count, 3, generator=generator) * (3.0 if inside else 0.5)
    return RayBatch(origins, normalize(targets - origins, dim=-1))


def narrowed(sdf, rays, beta, grid=None):
    grid = grid or EmptySpace(RADIUS)
    whole = sphere_interval(rays.origins, rays.directions, RADIUS)
    return whole, grid.narrow(sdf, rays, whole, torch.tensor(beta))


def true_weights(sdf, rays, beta, whole):
    """Positions along each ray and their blending weights, by quadrature of the true density."""
    edges = torch.lerp(
        whole.near[:, None].double(), whole.far[:, None].double(), torch.linspace(0, 1, 8001).double()
    )
    middle = 0.5 * (edges[:, 1:] + edges[:, :-1])
    points = rays.origins[:, None].double() + middle[..., None] * rays.directions[:, None].double()
    distance = sdf(points.float().reshape(-1, 3)).double().view(middle.shape)
    depth = laplace_density(distance, torch.tensor(beta, dtype=torch.float64)) * edges.diff(dim=-1)
    before = torch.nn.functional.pad(depth.cumsum(-1), (1, 0))
    return middle, torch.exp(-before[:, :-1]) - torch.exp(-before[:, 1:])


def assert_nothing_lost(sdf, rays, beta):
    whole, part = narrowed(sdf, rays, beta)
    assert (part.near >= whole.near).all()
    assert (part.far <= whole.far).all()
    assert (part.far >= part.near).all()
    allowed = empty_space.MAX_OPACITY_IN_TRAINING + math.exp(-empty_space.OPAQUE_DEPTH)
    place, weight = true_weights(sdf, rays, beta, whole)
    outside = (place < part.near[:, None]) | (place > part.far[:, None])
    assert (weight * outside).sum(-1).max() < allowed
    return whole, part


@pytest.mark.parametrize("beta", [0.1, 0.01, 0.001])
@pytest.mark.parametrize(
    "sdf", [sphere_distance, hollow, plate(0.2), plate(1e-3)], ids=["sphere", "hollow", "plate", "foil"]
)
@pytest.mark.parametrize("inside", [False, True])
def test_skipped_parts_have_no_weight(sdf, beta, inside):
    assert_nothing_lost(sdf, bundle(inside=inside), beta)


@settings(max_examples=25, deadline=None)
@given(
    share=st.floats(0.001, 2.0),
    tilt=st.floats(-1.5, 1.5),
    offset=st.floats(-0.8, 0.8),
    log_beta=st.floats(-3.0, -1.0),
    seed=st.integers(0, 99),
)
def test_no_thin_plate_is_lost(share, tilt, offset, log_beta, seed):
    """From a thousandth of a cell to two cells thick, at any position."""
    assert_nothing_lost(plate(share * CELL, tilt, offset), bundle(20, seed), 10.0**log_beta)


@pytest.mark.parametrize("beta", [0.1, 0.02, 0.003])
@pytest.mark.parametrize(
    "sdf", [sphere_distance, hollow, plate(0.2), plate(0.05)], ids=["sphere", "hollow", "plate", "sheet"]
)
def test_what_is_hidden_has_hardly_any_weight_with_the_entering_density_either(sdf, beta):
    rays = bundle(400)
    whole, part = narrowed(sdf, rays, beta)
    edges = torch.lerp(whole.near[:, None], whole.far[:, None], torch.linspace(0, 1, 8001))
    points = rays.origins[:, None] + edges[..., None] * rays.directions[:, None]
    depth = entering_depth(sdf(points.reshape(-1, 3)).view(edges.shape), torch.tensor(beta))
    weight = depth_weights(depth).weights
    middle = 0.5 * (edges[:, 1:] + edges[:, :-1])
    lost = (weight * ((middle < part.near[:, None]) | (middle > part.far[:, None]))).sum(-1)
    assert lost.max() < 2.0 * empty_space.MAX_OPACITY_IN_TRAINING
    assert (lost > empty_space.MAX_OPACITY_IN_TRAINING).float().mean() < 0.005


def test_grazing_rays_keep_the_surface_that_they_graze():
    height = torch.linspace(0.5, 0.75, 101)
    origins = torch.stack([torch.full_like(height, -2.5), height, torch.zeros_like(height)], -1)
    rays = RayBatch(origins, torch.tensor([1.0, 0.0, 0.0]).expand(101, 3))
    assert_nothing_lost(sphere_distance, rays, 0.01)


def test_most_of_a_mostly_empty_ray_is_skipped():
    whole, part = narrowed(sphere_distance, bundle(), 0.01)
    assert (part.far - part.near).sum() < 0.4 * (whole.far - whole.near).sum()


def test_an_empty_ray_keeps_its_interval():
    whole, part = narrowed(lambda x: x.norm(dim=-1) + 1.0, bundle(), 0.01)
    assert torch.equal(part.near, whole.near)
    assert torch.equal(part.far, whole.far)


@pytest.mark.parametrize("sdf", [sphere_distance, plate(0.3 * CELL)], ids=["sphere", "foil"])
def test_fewer_queries_find_the_same_surface(sdf):
    """The rendered median depth, compared with that of the true weights, from the part and from the whole
    ray.
    """
    rays, beta = bundle(), 0.01
    whole, part = narrowed(sdf, rays, beta)
    place, weight = true_weights(sdf, rays, beta, whole)
    opaque = weight.sum(-1) > 0.99
    truth = place.gather(-1, (weight.cumsum(-1) > 0.5).to(torch.int8).argmax(-1, keepdim=True))[opaque, 0]
    assert opaque.sum() > 40

    def run(interval):
        found = error_bounded_samples(sdf, rays, interval, torch.tensor(beta), COUNTS, False)
        t = found.distances
        points = rays.origins[:, None] + t[..., None] * rays.directions[:, None]
        depth = laplace_depth(sdf(points.reshape(-1, 3)).view_as(t), t, torch.tensor(beta))
        reached = torch.nn.functional.pad(depth_weights(depth).weights, (1, 0)).cumsum(-1)
        first = torch.searchsorted(reached, torch.full_like(t[:, :1], 0.5)).clamp(1, t.shape[1] - 1)
        low, high = reached.gather(-1, first - 1), reached.gather(-1, first)
        median = torch.lerp(
            t.gather(-1, first - 1), t.gather(-1, first), (0.5 - low) / (high - low).clamp_min(1e-9)
        )
        return (median[opaque, 0] - truth).abs(), found.sdf_queries

    (exact, more), (narrow, fewer) = run(whole), run(part)
    assert exact.max() < 0.5 * beta
    assert narrow.max() < 0.5 * beta
    assert fewer < 0.85 * more


# ---------------------------------------------------------------------------------- rays that leave a surface


def may_hit(sdf, rays, beta=0.01):
    whole = sphere_interval(rays.origins, rays.directions, RADIUS)
    return EmptySpace(RADIUS).may_hit(sdf, rays, whole, torch.tensor(beta))


def leaving(steepest=0.2, height=0.06):
    """Rays away from the sphere_distance, with a minimum angle to it, from a given height above it."""
    generator = torch.Generator().manual_seed(0)
    normal = normalize(torch.randn(300, 3, generator=generator), dim=-1)
    away = normalize(torch.randn(300, 3, generator=generator), dim=-1)
    away = torch.where((away * normal).sum(-1, keepdim=True) < 0, -away, away)
    steep = (away * normal).sum(-1) > steepest
    return RayBatch((0.6 + height) * normal[steep], away[steep])


def test_rays_that_leave_a_sphere_hit_nothing():
    assert may_hit(sphere_distance, leaving()).float().mean() < 0.03


@settings(max_examples=25, deadline=None)
@given(
    share=st.floats(0.001, 2.0),
    seed=st.integers(0, 99),
    tilt=st.floats(-1.5, 1.5),
    log_beta=st.floats(-3.0, -1.5),
)
def test_no_thin_plate_in_front_of_a_ray_is_missed(share, seed, tilt, log_beta):
    """Rays at least two cells in front of the plate, at least 10° towards it, that start above another
    surface.
    """
    normal = torch.tensor([math.sin(tilt), 0.2, math.cos(tilt)]) / math.sqrt(1.04)
    foil, generator = plate(share * CELL, tilt, 0.3), torch.Generator().manual_seed(seed)
    origins = normalize(torch.randn(200, 3, generator=generator), dim=-1)
    directions = normalize(torch.randn(200, 3, generator=generator), dim=-1)
    along = (0.3 - origins @ normal) / (directions @ normal)
    meets = (
        (along > 0)
        & ((directions @ normal).abs() > math.sin(math.radians(10.0)))
        & (foil(origins) > 2 * CELL)
    )
    meets &= (origins + along[:, None] * directions).norm(dim=-1) < RADIUS - CELL

    def scene(x):
        return torch.minimum(
            foil(x), (x.norm(dim=-1) - 0.9).abs() + 0.03
        )  # a shell that all rays leave or pass

    assert may_hit(scene, RayBatch(origins, directions)[meets], 10.0**log_beta).all()


# ----------------------------------------------------------------------------------------- a field that moves


def test_a_new_surface_is_detected_immediately():
    grid, rays = EmptySpace(RADIUS), bundle()
    narrowed(sphere_distance, rays, 0.01, grid)

    def moved(x):
        return torch.minimum(sphere_distance(x), (x - torch.tensor([0.0, 0.0, 1.2])).norm(dim=-1) - 0.5)

    whole, part = narrowed(moved, rays, 0.01, grid)
    assert torch.equal(part.near, whole.near)  # no ray skips anything
    for _ in range(empty_space.MIN_LIFE):
        grid.moved()
    narrowed(moved, rays, 0.01, grid)
    whole, part = narrowed(moved, rays, 0.01, grid)
    assert grid.age == 0  # sampled again
    assert (part.near > whole.near).any()


def test_the_grid_is_sampled_after_its_maximum_age():
    grid, rays, asked = EmptySpace(RADIUS), bundle(5), []

    def counted(x):
        asked.append(len(x))
        return sphere_distance(x)

    narrowed(counted, rays, 0.01, grid)
    assert sum(asked) == empty_space.RESOLUTION**3 + 5
    asked.clear()
    for _ in range(empty_space.MAX_LIFE):
        narrowed(counted, rays, 0.01, grid)
        grid.moved()
    assert sum(asked) == 5 * empty_space.MAX_LIFE  # one query per ray and use
    narrowed(counted, rays, 0.01, grid)
    assert grid.age == 0


def test_a_grid_from_a_checkpoint_skips_the_same_parts():
    one, other, rays = EmptySpace(RADIUS), EmptySpace(RADIUS), bundle()
    narrowed(sphere_distance, rays, 0.01, one)
    one.moved()
    other.load_state_dict(one.state_dict())
    assert other.age == 1
    _, first = narrowed(sphere_distance, rays, 0.01, one)
    _, second = narrowed(sphere_distance, rays, 0.01, other)
    assert torch.equal(first.near, second.near)
    assert torch.equal(first.far, second.far)


def test_the_bound_is_the_largest_slope_nearby():
    grid = EmptySpace(RADIUS)
    narrowed(lambda x: 3.0 * x[:, 1], bundle(2), 0.01, grid)
    assert torch.allclose(grid.slope, torch.tensor(empty_space.MARGIN * 3.0), rtol=1e-4)
    assert cell_size(grid.distance, RADIUS) == pytest.approx(CELL)
    narrowed(lambda x: 0.1 * x[:, 1], bundle(2), 0.01, grid := EmptySpace(RADIUS))
    assert torch.allclose(grid.slope, torch.tensor(empty_space.MARGIN))  # a signed distance has slope 1
    diagonal = torch.ones(3) / math.sqrt(3.0)
    narrowed(lambda x: 2.0 * x @ diagonal, bundle(2), 0.01, grid := EmptySpace(RADIUS))
    assert torch.allclose(grid.slope, torch.tensor(empty_space.MARGIN * 2.0), rtol=1e-4)


@pytest.mark.parametrize("steepness", [3.0, 8.0, 40.0])
def test_a_plateau_beside_a_steep_surface_is_not_skipped_up_to_the_surface(steepness):
    assert_nothing_lost(lambda x: (steepness * sphere_distance(x)).clamp_max(0.3), bundle(400), 0.01)


def test_a_steep_field_elsewhere_does_not_matter():
    """Learned fields are steep in some places."""

    def steep_inside(x):
        distance = sphere_distance(x)
        return torch.where(distance < -0.4, -0.4 + 8.0 * (distance + 0.4), distance)

    rays = bundle()
    whole, part = narrowed(steep_inside, rays, 0.01)
    _, plain = narrowed(sphere_distance, rays, 0.01)
    assert torch.equal(part.near, plain.near)
    assert (plain.near > whole.near + 0.5).float().mean() > 0.5
