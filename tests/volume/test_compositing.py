"""Weights along a ray, compared with the product formula and closed forms."""

from __future__ import annotations

import math

import numpy as np
import pytest
import torch

from neilfpp_method.volume.compositing import composite, depth_weights, render_weights, sample_weights


def product_formula(density, distances, far):
    """Weights of one ray by the textbook formula: alpha times the transmittance of the samples in front."""
    alpha = 1.0 - np.exp(-density * np.diff([*distances, far]))
    return alpha * np.cumprod([1.0, *(1.0 - alpha[:-1])])


def rays(count=5, samples=16):
    rng = np.random.default_rng(0)
    distances = np.sort(rng.uniform(0.0, 2.0, (count, samples)), axis=-1)
    return rng.uniform(0.0, 8.0, (count, samples)), distances, np.full(count, 2.1)


def test_weights_are_the_product_formula():
    density, distances, far = rays()
    found = render_weights(*map(torch.from_numpy, (density, distances, far)))
    expected = np.stack([product_formula(*ray) for ray in zip(density, distances, far, strict=True)])
    np.testing.assert_allclose(found.weights.numpy(), expected, rtol=1e-12, atol=1e-15)
    np.testing.assert_allclose(found.opacity.numpy(), expected.sum(-1), rtol=1e-12)
    np.testing.assert_allclose(found.transmittance.numpy(), 1.0 - expected.sum(-1), atol=1e-14)


def test_two_samples_by_hand():
    half = math.log(2.0)  # each interval, of length 1, lets half of the light through
    found = render_weights(torch.tensor([[half, half]]), torch.tensor([[0.0, 1.0]]), torch.tensor([2.0]))
    torch.testing.assert_close(found.weights, torch.tensor([[0.5, 0.5 * 0.5]]))
    torch.testing.assert_close(found.transmittance, torch.tensor([0.5 * 0.5]))
    blend = composite(found.weights, torch.tensor([[[1.0, 0.0, 2.0], [0.0, 4.0, 2.0]]]))
    torch.testing.assert_close(blend, torch.tensor([[0.5 * 1.0, 0.25 * 4.0, 0.75 * 2.0]]))


@pytest.mark.parametrize("sigma", [1e-6, 0.3, 5.0])
def test_a_homogeneous_slab_follows_beer_lambert_for_any_cuts(sigma):
    length = 1.7
    cuts = torch.tensor([[1.0, 1.01, 1.5, 1.5, 2.2]])
    found = render_weights(torch.full((1, 5), sigma), cuts, torch.tensor([1.0 + length]))
    expected = -math.expm1(-sigma * length)
    assert found.opacity.item() == pytest.approx(expected, rel=1e-6)
    assert found.weights.sum().item() == pytest.approx(expected, rel=1e-6)
    assert found.transmittance.item() == pytest.approx(math.exp(-sigma * length), rel=1e-6)


def test_half_of_the_weight_of_an_interval_goes_to_either_end():
    intervals = depth_weights(
        torch.tensor([[math.log(2.0), math.log(4.0)]])
    )  # let through one half, then one quarter
    torch.testing.assert_close(intervals.weights, torch.tensor([[0.5, 0.5 * 0.75]]))
    at_samples = sample_weights(intervals.weights)
    torch.testing.assert_close(at_samples, torch.tensor([[0.25, 0.25 + 0.1875, 0.1875]]))
    torch.testing.assert_close(at_samples.sum(-1), intervals.opacity)


def test_an_opaque_sample_occludes_later_samples():
    found = render_weights(
        torch.tensor([[0.0, 1e8, 3.0]]), torch.tensor([[0.0, 1.0, 2.0]]), torch.tensor([3.0])
    )
    assert found.weights.tolist() == [[0.0, 1.0, 0.0]]
    assert found.transmittance.item() == 0.0


def test_intervals_of_length_zero_have_no_weight():
    found = render_weights(torch.full((1, 3), 1e8), torch.full((1, 3), 2.0), torch.tensor([2.0]))
    assert found.weights.tolist() == [[0.0, 0.0, 0.0]]
    assert found.transmittance.item() == 1.0


def test_half_precision_is_summed_in_float32():
    half = torch.bfloat16
    distances = (torch.arange(256.0) / 256.0).to(half)  # exact: eight bits each
    found = render_weights(torch.ones(1, 256, dtype=half), distances[None], torch.ones(1, dtype=half))
    assert found.weights.dtype == torch.float32
    assert found.opacity.item() == pytest.approx(-math.expm1(-1.0), rel=1e-5)


def test_gradients_agree_with_differences():
    density, distances, far = (torch.from_numpy(a).requires_grad_() for a in rays(2, 5))
    values = torch.rand(2, 5, 3, dtype=torch.float64, requires_grad=True)

    def rendered(density, distances, far, values):
        found = render_weights(density, distances, far)
        return composite(found.weights, values), found.transmittance, found.opacity

    assert torch.autograd.gradcheck(rendered, (density, distances, far, values))


def test_samples_that_rounding_has_swapped_emit_nothing():
    """Two samples are swapped by one unit in the last place, in a medium in which that is an optical depth of
    −0.6.
    """
    distances = torch.tensor([[0.5, 1.0, 1.0, 1.5]])
    distances[0, 2] = torch.nextafter(distances[0, 1], torch.tensor(0.0))
    found = render_weights(torch.tensor([[0.0, 1e7, 0.0, 0.1]]), distances, torch.tensor([2.0]))
    assert (found.weights >= 0).all()
    assert found.weights[0, 1] == 0
    torch.testing.assert_close(found.opacity, -torch.expm1(torch.tensor([-0.05])))
