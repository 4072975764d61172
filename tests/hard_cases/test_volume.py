"""Volume rendering with extreme numbers: values and gradients are finite and bounded."""

from __future__ import annotations

import pytest
import torch

from neilfpp_method.stratified.intervals import inverse_cdf_samples
from neilfpp_method.structures import RayBatch
from neilfpp_method.volume.compositing import composite, render_weights
from neilfpp_method.volume.density import laplace_density
from neilfpp_method.volume.intersect import Interval, sphere_interval
from neilfpp_method.volume.partition import SampleCounts
from neilfpp_method.volume.samplers import error_bounded_samples
from tests.scenes import sphere_distance

COUNTS = SampleCounts(cuts=16, rounds=5, rendered=8)


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
@pytest.mark.parametrize("beta", [1e-4, 1.0])
@pytest.mark.parametrize("sdf", [-1e6, -1.0, -1e-30, 0.0, 1e-30, 1.0, 1e6])
def test_density_and_its_slopes_are_bounded(sdf, beta, dtype):
    sdf = torch.tensor(sdf, dtype=dtype, requires_grad=True)
    beta = torch.tensor(beta, dtype=dtype, requires_grad=True)
    density = laplace_density(sdf, beta)
    density.backward()
    assert 0.0 <= density <= 1.0 / beta
    assert sdf.grad.abs() <= 0.5001 / beta**2
    assert beta.grad.abs() <= 1.0001 / beta**2


@pytest.mark.parametrize("sigma", [0.0, 1e-30, 1.0, 1e8])
@pytest.mark.parametrize("span", [0.0, 1e-30, 1.0, 1e4])
def test_weights_and_transmittance_add_up_to_one(sigma, span):
    density = torch.full((2, 4), sigma, requires_grad=True)
    distances = torch.tensor([[0.0, 0.0, 0.5, 0.5], [0.0, 0.25, 0.5, 1.0]]) * span
    found = render_weights(density, distances, torch.full((2,), span))
    blended = composite(found.weights, torch.ones(2, 4, 3))
    (blended.sum() + found.transmittance.sum() + found.opacity.sum()).backward()
    assert blended.isfinite().all()
    torch.testing.assert_close(blended[:, 0] + found.transmittance, torch.ones(2))
    assert density.grad.isfinite().all()
    assert (
        density.grad.abs().max() <= 5.0 * span
    )  # each derivative is at most the interval's width; five add up


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64, torch.bfloat16])
@pytest.mark.parametrize("stochastic", [False, True])
@pytest.mark.parametrize("beta", [1e-4, 0.01, 10.0])
def test_samples_are_ordered_and_within_their_interval(beta, stochastic, dtype):
    """Rays through the centre, grazing rays, rays that miss the scene, rays of length 0, and rays that start
    on the surface.
    """
    origins = torch.tensor([[-2.0, 0, 0], [-2, 0.6, 0], [-2, 5, 0], [4, 0, 0], [0.6, 0, 0]], dtype=dtype)
    directions = torch.tensor([[1.0, 0.0, 0.0]], dtype=dtype).expand(5, 3)
    interval = sphere_interval(origins, directions, 3.0)
    scale = torch.tensor(beta, dtype=dtype)
    found = error_bounded_samples(
        sphere_distance, RayBatch(origins, directions), interval, scale, COUNTS, stochastic
    )
    assert found.distances.dtype == dtype
    assert found.distances.isfinite().all()
    assert (found.distances >= interval.near[:, None]).all()
    assert (found.distances <= interval.far[:, None]).all()
    assert (found.distances.diff(dim=-1) >= 0.0).all()
    assert ((found.error_bound >= 0.0) & (found.error_bound <= 1.0)).all()
    assert (found.distances[2:4] == interval.near[2:4, None]).all()
    assert (found.error_bound[2:4] == 0.0).all()


@pytest.mark.parametrize("constant", [-1e6, 0.0, 1e6])
def test_sampler_with_a_constant_sdf(constant):
    origins, directions = torch.zeros(2, 3), torch.tensor([[1.0, 0.0, 0.0]]).expand(2, 3)
    far = torch.tensor([0.0, 3.0])
    found = error_bounded_samples(
        lambda x: torch.full_like(x[:, 0], constant),
        RayBatch(origins, directions),
        Interval(torch.zeros(2), far),
        torch.tensor(1e-4),
        COUNTS,
        False,
    )
    assert found.distances.isfinite().all()
    assert (found.distances <= far[:, None]).all()


def test_sampler_takes_a_half_precision_sdf():
    origins, directions = torch.tensor([[-2.0, 0.0, 0.0]]), torch.tensor([[1.0, 0.0, 0.0]])
    found = error_bounded_samples(
        lambda x: sphere_distance(x).bfloat16(),
        RayBatch(origins, directions),
        Interval(torch.tensor([0.0]), torch.tensor([4.0])),
        torch.tensor(0.01),
        COUNTS,
        False,
    )
    assert found.distances.dtype == torch.float32
    assert (found.distances.median() - 1.4).abs() < 0.03


@pytest.mark.parametrize("mass", [0.0, 1e-42, 1e-30, 1e30])
@pytest.mark.parametrize("span", [0.0, 1e-30, 1.0])
def test_inverse_cdf_of_a_uniform_mass_is_uniform(mass, span):
    edges = torch.tensor([[0.0, 0.25, 0.5, 0.75, 1.0]]) * span
    samples = inverse_cdf_samples(edges, torch.full((1, 4), mass), 4, False)
    expected = torch.tensor([[0.125, 0.375, 0.625, 0.875]]) * span
    torch.testing.assert_close(samples, expected, atol=1e-6 * span, rtol=1e-5)


def test_an_empty_batch_of_rays():
    empty = torch.zeros(0)
    rays, interval = RayBatch(torch.zeros(0, 3), torch.zeros(0, 3)), Interval(empty, empty)
    found = error_bounded_samples(sphere_distance, rays, interval, torch.tensor(0.1), COUNTS, True)
    assert found.distances.shape == (0, 8)
    assert found.sdf_queries == 0
