"""The sampler for the entering density, compared with the exact opacity of known surfaces."""

from __future__ import annotations

import math

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from neilfpp_method.structures import RayBatch
from neilfpp_method.volume.compositing import depth_weights
from neilfpp_method.volume.density import depth_at, entering_depth
from neilfpp_method.volume.entering_samples import entering_samples, possible_weights
from neilfpp_method.volume.intersect import Interval
from neilfpp_method.volume.partition import SampleCounts, cut
from tests.scenes import sphere_distance

COUNTS = SampleCounts(cuts=32, rounds=0, rendered=32)


def parallel_rays(offset, near=1.0, far=3.0):
    """Rays along z at heights `offset` above the z axis, from z = −2, and their interval."""
    count = len(offset)
    origins = torch.stack([offset, torch.zeros(count), torch.full((count,), -2.0)], dim=-1)
    rays = RayBatch(origins, torch.tensor([0.0, 0.0, 1.0]).expand(count, 3))
    return rays, Interval(torch.full((count,), near), torch.full((count,), far))


def values(sdf, rays, distances):
    points = rays.origins[:, None] + distances[..., None] * rays.directions[:, None]
    return sdf(points.reshape(-1, 3)).view(distances.shape)


@pytest.mark.parametrize("stochastic", [False, True])
def test_samples_are_sorted_between_both_ends_and_cost_two_queries_per_cut(stochastic):
    rays, interval = parallel_rays(torch.linspace(0.0, 1.0, 50))
    asked = []

    def counted(x):
        asked.append(len(x))
        return sphere_distance(x)

    distances = entering_samples(counted, rays, interval, torch.tensor(0.01), COUNTS, stochastic)
    assert distances.shape == (50, COUNTS.rendered)
    assert (distances.diff(dim=-1) >= 0.0).all()
    assert torch.equal(distances[:, 0], interval.near)
    assert torch.equal(distances[:, -1], interval.far)
    assert sum(asked) == 50 * 2 * COUNTS.cuts


@pytest.mark.parametrize("stochastic", [False, True])
@pytest.mark.parametrize("beta", [0.05, 0.01, 0.002])
def test_the_opacity_of_rays_past_a_sphere_is_that_of_their_smallest_distance(beta, stochastic):
    """Rays that hit the sphere, graze it and miss it."""
    offset = torch.linspace(0.4, 0.8, 400)
    rays, interval = parallel_rays(offset)
    torch.manual_seed(0)
    distances = entering_samples(sphere_distance, rays, interval, torch.tensor(beta), COUNTS, stochastic)
    found = depth_weights(
        entering_depth(values(sphere_distance, rays, distances), torch.tensor(beta))
    ).opacity
    radius = -sphere_distance(torch.zeros(1, 3))
    true = -torch.expm1(-depth_at(offset - radius, torch.tensor(beta)))
    assert (true > 0.9).sum() > 20
    assert (true < 0.1).sum() > 20
    assert (found - true).abs().max() < 0.05
    assert (found - true).abs().mean() < 0.002


@pytest.mark.parametrize("radius", [0.002, 0.005])
@pytest.mark.parametrize("stochastic", [False, True])
def test_a_wire_in_front_of_a_wall_is_found(radius, stochastic):
    """A wire of a tenth or a fifth of the distance between the first cuts, in front of an opaque wall."""
    offset, beta = torch.linspace(-2.0 * radius, 2.0 * radius, 401), torch.tensor(radius / 2.0)
    rays, interval = parallel_rays(offset, near=1.5, far=3.1)

    def wire_and_wall(x):
        wire = (x[:, 0].square() + (x[:, 2] - 0.2).square()).sqrt() - radius
        return torch.minimum(wire, 1.0 - x[:, 2])

    torch.manual_seed(0)
    distances = entering_samples(wire_and_wall, rays, interval, beta, COUNTS, stochastic)
    weights = depth_weights(entering_depth(values(wire_and_wall, rays, distances), beta)).weights
    in_front = (weights * (distances[:, 1:] < 2.5)).sum(-1)
    true = -torch.expm1(-depth_at(offset.abs() - radius, beta))
    assert (in_front - true).abs().mean() < 0.04


@settings(max_examples=50, deadline=None)
@given(seed=st.integers(0, 10_000), log_beta=st.floats(-3.0, -0.5), cuts=st.integers(4, 40))
def test_no_interval_has_more_weight_than_is_possible(seed, log_beta, cuts):
    """For rays through five random balls, with the true weight of an interval by 400 samples in each."""
    generator = torch.Generator().manual_seed(seed)
    centers = torch.randn(5, 3, generator=generator) * 0.4
    radii = torch.rand(5, generator=generator) * 0.2

    def balls(x):
        return (torch.cdist(x, centers) - radii).amin(dim=-1)

    rays, _ = parallel_rays(torch.rand(10, generator=generator))
    beta = torch.tensor(10.0**log_beta)
    distances = torch.linspace(0.0, 4.0, cuts).expand(10, cuts)
    possible = possible_weights(cut(distances, values(balls, rays, distances)), beta)
    fine = torch.linspace(0.0, 4.0, 400 * (cuts - 1) + 1).expand(10, -1)
    true = depth_weights(entering_depth(values(balls, rays, fine), beta)).weights
    assert (true.view(10, cuts - 1, 400).sum(-1) <= possible * (1.0 + 1e-4) + 1e-5).all()


def test_the_depth_of_a_ray_is_that_of_its_smallest_distance():
    along, beta = torch.tensor([3.0, 1.0, 0.1, 0.5, 2.0]), torch.tensor(0.2)
    total = entering_depth(along, beta).sum()
    assert total.item() == pytest.approx(depth_at(along.min(), beta).item(), rel=1e-6)
    assert total.item() == pytest.approx(0.5 * math.exp(-0.5), rel=1e-6)
