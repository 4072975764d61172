"""The losses of METHOD §4, each compared with a value that is computed by hand."""

from __future__ import annotations

import math

import pytest
import torch

from neilfpp_method import losses
from neilfpp_method.structures import LossTerm, Material


def test_photometric_is_l1_over_the_scale_in_linear_radiance():
    radiance = torch.tensor([[0.5, 1.5, 2.0]])
    pixel = torch.tensor([[0.2, 1.0, 3.0]])
    term = losses.photometric(radiance, pixel, "linear", unit=3.0)
    assert term.values.tolist()[0] == pytest.approx([0.3 / 3, 0.5 / 3, 1.0 / 3])


def test_without_noise_the_physical_loss_is_the_photometric_one():
    radiance, pixel = torch.rand(50, 3, requires_grad=True), torch.rand(50, 3)
    for response in ("linear", "srgb"):
        found = []
        for term in (
            losses.physical(radiance, radiance, pixel, response, 2.0),
            losses.photometric(radiance, pixel, response, 2.0),
        ):
            found.append((term.values, *torch.autograd.grad(term.mean(), radiance)))
        torch.testing.assert_close(*found)


def test_the_physical_loss_does_not_prefer_little_noise():
    """Estimates mean + deviation · noise of a pixel. The absolute error of one estimate grows with the
    deviation: its derivative is √(2/π) for normal noise.
    """
    generator = torch.Generator().manual_seed(0)
    noise = torch.randn(2, 200_000, 3, generator=generator)
    mean, deviation = (torch.tensor(value, requires_grad=True) for value in (0.5, 0.2))
    one, other = mean + deviation * noise
    pixel = torch.full_like(one, 0.5)

    def derivatives(term):
        return [g.item() for g in torch.autograd.grad(term.mean(), (mean, deviation), retain_graph=True)]

    biased = derivatives(losses.photometric(one, pixel, "linear"))
    assert biased == pytest.approx([0.0, (2 / math.pi) ** 0.5], abs=0.005)
    assert derivatives(losses.physical(one, other, pixel, "linear")) == pytest.approx([0.0, 0.0], abs=0.005)
    # A mean that is off by half a deviation: the sign of an error is right with probability 0.69.
    found = derivatives(losses.physical(one, other, pixel - 0.1, "linear"))
    assert found == pytest.approx([0.383, 0.0], abs=0.005)
    term = losses.physical(one, other, pixel, "linear")
    torch.testing.assert_close(term.values, (0.5 * (one + other) - pixel).abs())


def test_a_clipped_pixel_is_a_lower_bound_for_both_estimates():
    one, other = torch.full((1, 3), 4.0, requires_grad=True), torch.full((1, 3), 0.1, requires_grad=True)
    term = losses.physical(one, other, torch.ones(1, 3), "srgb")
    assert not any(gradient.any() for gradient in torch.autograd.grad(term.mean(), (one, other)))


def test_photometric_clips_and_encodes_for_ldr_pixels():
    term = losses.photometric(torch.tensor([[0.0, 0.5, 7.0]]), torch.tensor([[0.0, 0.735357, 1.0]]), "srgb")
    assert term.values.abs().max() < 1e-5  # sRGB(0.5) = 0.735357; 7 clips to 1


def test_eikonal_is_the_distance_of_the_slope_from_one():
    gradient = torch.tensor([[3.0, 4.0, 0.0], [0.0, 1.0, 0.0]])
    assert losses.eikonal(gradient).values.tolist() == pytest.approx([4.0, 0.0])


def test_surface_is_a_delta_of_unit_mass():
    z = torch.linspace(-200.0, 200.0, 400_001, dtype=torch.float64)
    values = losses.surface(z, 0.05).values
    assert torch.trapezoid(values, z).item() == pytest.approx(1.0, abs=2e-4)
    assert values.max().item() == pytest.approx(1.0 / (math.pi * 0.05))


def test_point_cloud_adds_distance_and_angle():
    distance = torch.tensor([0.1, -0.2])
    gradient = torch.tensor([[0.0, 0.0, 2.0], [1.0, 0.0, 0.0]])
    normal = torch.tensor([[0.0, 0.0, 1.0], [0.0, 1.0, 0.0]])
    assert losses.point_cloud(distance, gradient, normal).values.tolist() == pytest.approx([0.1, 0.2 + 1.0])


def test_smoothness_is_weaker_where_the_image_changes():
    gradient = torch.tensor([[0.0, 3.0, 4.0]])
    term = losses.smoothness(gradient, 2.0 * gradient, torch.tensor([1.0]))
    assert term.values.item() == pytest.approx((5.0 + 10.0) * math.exp(-1.0))


def test_smoothness_does_not_move_an_almost_constant_field():
    """Near 0 the direction of a gradient is rounding noise, and the norm would make a full step of it."""
    steep, flat = torch.tensor([[0.0, 0.02, 0.0]]), torch.tensor([[0.0, 0.005, 0.0]])
    for gradient, pull in ((steep, 1.0), (flat, 0.0)):
        gradient.requires_grad_(True)
        losses.smoothness(gradient, torch.zeros(1, 3), torch.zeros(1)).values.sum().backward()
        assert gradient.grad.norm().item() == pytest.approx(pull)


def test_lambertian_is_zero_for_a_rough_dielectric_only():
    one, zero = torch.ones(1, 1), torch.zeros(1, 1)
    assert losses.lambertian(Material(torch.ones(1, 3), one, zero)).values.item() == 0.0
    assert losses.lambertian(
        Material(torch.ones(1, 3), 0.25 * one, 0.5 * one)
    ).values.item() == pytest.approx(1.25)


BETA = torch.tensor(0.002)
"""Scale of the density, scene units."""


def test_mask_loss_counts_only_known_pixels():
    depth = torch.full((4,), math.e - 1)
    on_object, known = torch.tensor([1.0, 0.0, 1.0, 0.5]), torch.tensor([1.0, 1.0, 0.0, 1.0])
    term = losses.mask(depth, on_object, known, beta=torch.tensor(losses.MISS_DISTANCE))
    on_it = math.exp(1 - math.e) + math.log1p(1 / (math.e - 1))
    assert term.values.tolist() == pytest.approx([on_it, 1.0, 0.0, (1 + on_it) / 2])


def test_the_gradient_of_the_mask_loss_is_nonzero_and_bounded():
    depth = torch.tensor([0.0, 0.1, 10.0, 1e4], requires_grad=True)
    losses.mask(depth, torch.zeros(4), torch.ones(4), BETA).values.sum().backward()
    assert depth.grad.tolist() == pytest.approx([1.0, 1 / 1.1, 1 / 11, 1e-4], rel=1e-3)


def test_the_mask_loss_pulls_the_surface_to_rays_that_miss_it():
    """The gradient per distance is the same for a miss by 5 β and by 20 β, where the opacity is 2e-9."""
    missed_by = torch.tensor([5.0, 20.0], dtype=torch.float64) * BETA
    depth = (-missed_by.requires_grad_() / BETA).exp()
    term = losses.mask(depth, torch.ones(2), torch.ones(2), BETA)
    (gradient,) = torch.autograd.grad(term.values.sum(), missed_by)
    assert gradient.tolist() == pytest.approx([1 / losses.MISS_DISTANCE] * 2, rel=0.1)


def test_the_mask_loss_is_finite_without_any_density():
    depth = torch.zeros(1, requires_grad=True)
    term = losses.mask(depth, torch.ones(1), torch.ones(1), BETA)
    term.values.sum().backward()
    assert term.values.isfinite().all()
    assert depth.grad.isfinite().all()


def test_scale_gradient_keeps_the_value():
    x = torch.tensor([2.0], requires_grad=True)
    for scale in (0.1, 1.0):
        scaled = losses.scale_gradient(x, scale)
        assert scaled.item() == pytest.approx(2.0)
        assert torch.autograd.grad(scaled.sum(), x)[0].item() == pytest.approx(scale)
    assert not losses.scale_gradient(x, 0.0).requires_grad


def test_a_weighted_mean_uses_the_weights():
    values = torch.tensor([[1.0, 3.0], [10.0, 30.0]])
    assert LossTerm(values, torch.tensor([[1.0], [0.0]])).mean().item() == pytest.approx(2.0)


def test_a_term_without_values_is_zero_with_a_zero_gradient():
    x = torch.ones(0, 3, requires_grad=True)
    mean = LossTerm(x).mean()
    mean.backward()
    assert mean.item() == 0.0


@pytest.mark.parametrize("loss", [losses.eikonal, lambda g: losses.smoothness(g, g, torch.zeros(len(g)))])
def test_a_zero_gradient_of_the_field_gives_finite_gradients(loss):
    gradient = torch.zeros(2, 3, requires_grad=True)
    loss(gradient).values.sum().backward()
    assert gradient.grad.isfinite().all()


def test_losses_are_differentiable():
    torch.manual_seed(0)
    vector = torch.randn(4, 3, dtype=torch.float64, requires_grad=True)
    scalar = torch.rand(4, dtype=torch.float64, requires_grad=True)
    assert torch.autograd.gradcheck(lambda v: losses.eikonal(v).values, vector)
    assert torch.autograd.gradcheck(lambda s: losses.surface(s, 0.05).values, scalar)
    normal = torch.nn.functional.normalize(torch.randn(4, 3, dtype=torch.float64), dim=-1)
    assert torch.autograd.gradcheck(lambda s, v: losses.point_cloud(s, v, normal).values, (scalar, vector))
    assert torch.autograd.gradcheck(lambda v, s: losses.smoothness(v, 2.0 * v, s).values, (vector, scalar))
