"""Ray samplers: their distributions, and the error bound compared with quadrature of the true density."""

from __future__ import annotations

import dataclasses
import math

import numpy as np
import pytest
import torch
from scipy.stats import laplace

from neilfpp_method.settings.presets import preset
from neilfpp_method.structures import RayBatch
from neilfpp_method.volume import samplers
from neilfpp_method.volume.compositing import render_weights
from neilfpp_method.volume.density import laplace_density
from neilfpp_method.volume.intersect import Interval
from neilfpp_method.volume.partition import SPREAD_SHARE, SampleCounts, cut, sample_counts
from neilfpp_method.volume.samplers import OPACITY_ERROR, error_bounded_samples
from tests.scenes import sphere_distance

F64 = torch.float64
COUNTS = SampleCounts(cuts=128, rounds=5, rendered=98)
TILT = torch.tensor([0.36, 0.48, 0.8], dtype=F64)  # a unit vector


def thin_plate(x):
    return (x[:, 0] - 0.1).abs() - 0.01


def tilted_plane(x):
    return x @ TILT.to(x) - 0.2


SURFACES = [sphere_distance, thin_plate, tilted_plane]


def ray_bundle(count, dtype=F64):
    """Rays from a shell of radius 2.5 towards the object; some miss it."""
    generator = torch.Generator().manual_seed(3)
    origins = (
        torch.nn.functional.normalize(torch.randn(count, 3, generator=generator, dtype=F64), dim=-1) * 2.5
    )
    targets = 0.4 * torch.randn(count, 3, generator=generator, dtype=F64)
    directions = torch.nn.functional.normalize(targets - origins, dim=-1)
    return (
        origins.to(dtype),
        directions.to(dtype),
        torch.zeros(count, dtype=dtype),
        torch.full((count,), 5.0).to(dtype),
    )


def sample(sdf, rays, beta, counts=COUNTS, stochastic=False):
    origins, directions, near, far = rays
    beta = torch.tensor(beta, dtype=near.dtype)
    interval = Interval(near, far)
    return error_bounded_samples(sdf, RayBatch(origins, directions), interval, beta, counts, stochastic)


# -------------------------------------------------------------------------------------------- the error bound


def distance_beyond_two_balls(width, a, b):
    """Brute force: the distance from the segment [0, width] on an axis to the nearest point outside the discs
    at its two ends.
    """
    angle = np.linspace(0.0, np.pi, 20_001)
    first = np.stack([a * np.cos(angle), a * np.sin(angle)], -1)
    second = np.stack([width + b * np.cos(angle), b * np.sin(angle)], -1)
    outline = np.concatenate(
        [first[np.hypot(first[:, 0] - width, first[:, 1]) >= b], second[np.hypot(*second.T) >= a]]
    )
    return np.hypot(outline[:, 0] - outline[:, 0].clip(0.0, width), outline[:, 1]).min()


def test_least_distance_is_that_to_the_outline_of_the_two_balls():
    rng = np.random.default_rng(0)
    for _ in range(40):
        width, a = rng.uniform(0.1, 1.0, 2)
        b = rng.uniform(max(a - width, 0.0), a + width)  # a distance changes by at most the step
        if a + b < width:
            continue
        found = cut(torch.tensor([[0.0, width]], dtype=F64), torch.tensor([[a, b]], dtype=F64)).least_distance
        assert found.item() == pytest.approx(distance_beyond_two_balls(width, a, b), abs=2e-4)


@pytest.mark.parametrize("ends", [(0.1, 0.2), (-0.8, 0.9), (0.9, -0.8), (0.0, 1.0)])
def test_least_distance_is_zero_if_the_surface_may_cross(ends):
    found = cut(torch.tensor([[0.0, 1.0]]), torch.tensor([ends])).least_distance
    assert found.item() == 0.0


def test_the_bound_is_that_of_the_theorem():
    """Transcribed: on interval k, exp(−Σ_{j<k} σ_j δ_j) · (exp(Σ_{j≤k} δ_j² exp(−d*_j/β) / 4β²) − 1)."""
    rng = np.random.default_rng(0)
    beta, distances = 0.2, np.sort(rng.uniform(0.0, 2.0, 12))
    sdf = 0.9 - 0.8 * distances
    partition = cut(torch.from_numpy(distances)[None], torch.from_numpy(sdf)[None])
    least, width = partition.least_distance[0].numpy(), np.diff(distances)
    density = laplace.cdf(-sdf, scale=beta) / beta
    expected = max(
        math.exp(-sum(density[:k] * width[:k]))
        * (math.exp(sum(width[: k + 1] ** 2 * np.exp(-least[: k + 1] / beta)) / (4 * beta**2)) - 1.0)
        for k in range(11)
    )
    found = samplers.log_error_bound(partition, torch.tensor([[beta]], dtype=F64))
    assert found.exp().item() == pytest.approx(expected, rel=1e-9)


def opacity_error(sdf, rays, beta, cuts):
    """max_t |O(t) − Ô(t)| of one ray: O by fine quadrature, Ô with constant density between cuts."""
    origin, direction, near, far = (part[0] for part in rays)
    t = torch.linspace(near.item(), far.item(), 400_001, dtype=F64)
    density = laplace.cdf(-sdf(origin + t[:, None] * direction).numpy(), scale=beta) / beta
    step = (t[1] - t[0]).item()
    truth = -np.expm1(-np.concatenate([[0.0], np.cumsum(0.5 * (density[1:] + density[:-1]) * step)]))
    at_cuts = laplace.cdf(-sdf(origin + cuts[:, None] * direction).numpy(), scale=beta) / beta
    cuts = cuts.numpy()
    depth = np.concatenate([[0.0], np.cumsum(at_cuts[:-1] * np.diff(cuts))])
    last = (np.searchsorted(cuts, t.numpy(), side="right") - 1).clip(0)
    return np.abs(truth + np.expm1(-(depth[last] + (t.numpy() - cuts[last]) * at_cuts[last]))).max()


@pytest.mark.parametrize("sdf", SURFACES)
@pytest.mark.parametrize("beta", [0.1, 0.02, 0.005])
@pytest.mark.parametrize("rounds", [0, 5])
def test_the_opacity_is_within_the_bound_and_the_bound_within_epsilon(sdf, beta, rounds):
    counts = dataclasses.replace(COUNTS, rounds=rounds)
    bundle = ray_bundle(4)
    for i in range(4):
        ray = [part[i : i + 1] for part in bundle]
        asked = []

        def recorded(x, ray=ray, asked=asked):
            asked.append((x - ray[0]) @ ray[1][0])
            return sdf(x)

        found = sample(recorded, ray, beta, counts)
        error = opacity_error(sdf, ray, beta, torch.cat(asked).sort().values)
        assert error <= found.error_bound.item() + 1e-5
        if rounds:
            assert found.error_bound.item() <= OPACITY_ERROR


def test_rays_that_skip_empty_space_are_cut_less_often():
    skipping = sample_counts(preset("fast").host.volume)
    assert skipping == SampleCounts(cuts=64, rounds=2, rendered=32)
    assert skipping.of_narrowed_rays() == SampleCounts(cuts=32, rounds=2, rendered=32)
    assert sample_counts(preset("paper-mlp").host.volume) == COUNTS


def test_the_bound_shows_when_the_rounds_were_too_few():
    found = sample(sphere_distance, ray_bundle(16), 1e-4, dataclasses.replace(COUNTS, rounds=0))
    assert (found.error_bound > OPACITY_ERROR).any()
    assert found.distances.isfinite().all()


# ---------------------------------------------------------------------------------- the error-bounded sampler


@pytest.mark.parametrize("stochastic", [False, True])
def test_samples_are_dense_at_the_surface(stochastic):
    torch.manual_seed(0)
    origins, directions, _, far = rays = ray_bundle(200, torch.float32)
    closest = -(origins * directions).sum(-1)
    gap = (origins.square().sum(-1) - closest.square()).sqrt()
    hits = gap < 0.5
    exact = (closest - (0.36 - gap.square()).clamp_min(0.0).sqrt())[hits]

    beta = 0.002
    distances = sample(sphere_distance, rays, beta, stochastic=stochastic).distances
    points = origins[:, None] + distances[..., None] * directions[:, None]
    density = laplace_density(
        sphere_distance(points.reshape(-1, 3)).reshape(distances.shape), torch.tensor(beta)
    )
    weights = render_weights(density, distances, far).weights
    depth = ((weights * distances).sum(-1) / weights.sum(-1))[hits]
    assert hits.sum() > 100
    assert (weights.sum(-1)[hits] > 0.999).all()
    assert (depth - exact).abs().max() < 3 * beta
    assert (distances.median(dim=-1).values[hits] - exact).abs().max() < 3 * beta


def test_a_thin_plate_is_not_missed():
    origins, directions, _, far = rays = ray_bundle(64, torch.float32)
    crossing = (0.1 - origins[:, 0]) / directions[:, 0]
    crosses = (crossing > 0.1) & (crossing < 4.9)
    found = sample(thin_plate, rays, 0.002)
    points = origins[:, None] + found.distances[..., None] * directions[:, None]
    density = laplace_density(
        thin_plate(points.reshape(-1, 3)).reshape(points.shape[:2]), torch.tensor(0.002)
    )
    opacity = render_weights(density, found.distances, far).opacity
    # Along the normal the plate's optical depth is 0.02 / 0.002, so at most exp(−10) is transmitted.
    assert crosses.sum() > 10
    assert (opacity[crosses] > 0.99).all()


def test_samples_follow_the_true_opacity():
    """In an opaque plane with soft density, the share of samples before t is the opacity up to t, within
    ε.
    """
    origins, directions = torch.zeros(1, 3, dtype=F64), torch.tensor([[0.0, 0.0, 1.0]], dtype=F64)
    rays = (origins, directions, torch.zeros(1, dtype=F64), torch.full((1,), 4.0, dtype=F64))
    beta = 0.1
    found = sample(lambda x: 1.0 - x[:, 2], rays, beta, dataclasses.replace(COUNTS, rendered=512))
    t = found.distances[0].numpy()
    # The antiderivative of Ψ(t − 1)/β: ½ e^{(t−1)/β} before the plane, ½ e^{−(t−1)/β} + (t − 1)/β behind it.
    depth = np.where(t < 1, 0.5 * np.exp((t - 1) / beta), 0.5 * np.exp(-(t - 1) / beta) + (t - 1) / beta)
    opacity = -np.expm1(-(depth - 0.5 * math.exp(-1 / beta)))
    share = (np.arange(510) + 0.5) / 510
    # The third that is spread follows the cuts, which are nearly uniform here, in addition to both ends.
    spread = (t[1:-1] / 4.0 - opacity[1:-1]) * SPREAD_SHARE
    assert np.abs(share - opacity[1:-1] - spread).max() <= found.error_bound.item()
    assert t[0] == 0.0
    assert t[-1] == 4.0


def test_queries_are_counted_and_not_repeated():
    asked = []

    def recorded(x):
        asked.append(x)
        return sphere_distance(x)

    found = sample(recorded, ray_bundle(50), 0.01)
    points = torch.cat(asked)
    assert found.sdf_queries == len(points) / 50
    assert len(points.unique(dim=0)) == len(points)
    assert 128 <= found.sdf_queries < 128 * 6  # converged rays are removed


def test_a_ray_does_not_depend_on_other_rays():
    bundle = ray_bundle(20)
    together = sample(sphere_distance, bundle, 0.005)
    for i in range(20):
        alone = sample(sphere_distance, [part[i : i + 1] for part in bundle], 0.005)
        torch.testing.assert_close(together.distances[i : i + 1], alone.distances)
        torch.testing.assert_close(together.error_bound[i : i + 1], alone.error_bound)


def test_without_removing_rays_the_bound_is_met_as_well(monkeypatch):
    monkeypatch.setattr(samplers, "can_leave_early", lambda device: False)
    found = sample(sphere_distance, ray_bundle(50), 0.01)
    assert found.sdf_queries == 128 * (1 + 5)
    assert (found.error_bound <= OPACITY_ERROR).all()
    assert (found.distances.diff(dim=-1) >= 0.0).all()


def test_cuts_by_contribution_are_better_than_cuts_by_the_bound(monkeypatch):
    """The rule of the paper, transcribed: it needs more queries for the same bound."""

    def bound_itself(partition, beta):
        error, depth = samplers.depth_error(partition, beta), samplers.optical_depth(partition, beta)
        return torch.expm1(error.clamp_max(80.0)) * torch.exp(-depth)

    ours = sample(sphere_distance, ray_bundle(200), 0.01)
    monkeypatch.setattr(samplers, "bound_shares", bound_itself)
    papers = sample(sphere_distance, ray_bundle(200), 0.01)
    assert (ours.error_bound <= OPACITY_ERROR).float().mean() >= (
        papers.error_bound <= OPACITY_ERROR
    ).float().mean()
    assert ours.sdf_queries < papers.sdf_queries


def test_central_samples_are_deterministic_and_random_ones_depend_on_the_seed():
    rays = ray_bundle(4)
    assert torch.equal(
        sample(sphere_distance, rays, 0.02).distances, sample(sphere_distance, rays, 0.02).distances
    )
    draws = []
    for seed in (1, 1, 2):
        torch.manual_seed(seed)
        draws.append(sample(sphere_distance, rays, 0.02, stochastic=True).distances)
    assert torch.equal(draws[0], draws[1])
    assert not torch.equal(draws[0], draws[2])


def test_samples_have_no_gradient():
    beta = torch.tensor(0.02, dtype=F64, requires_grad=True)
    origins, directions, near, far = ray_bundle(2)
    rays, interval = RayBatch(origins, directions), Interval(near, far)
    found = error_bounded_samples(sphere_distance, rays, interval, beta, COUNTS, True)
    assert not found.distances.requires_grad
    assert not found.error_bound.requires_grad
