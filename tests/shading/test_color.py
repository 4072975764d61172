"""The sRGB curve compared with its standard, and the responses of images."""

from __future__ import annotations

import pytest
import torch

from neilfpp_method.errors import UserError
from neilfpp_method.shading.color import (
    apply_response,
    at_common_exposure,
    display_values,
    linear_to_srgb,
    luminance,
    residual,
    response_slope,
    srgb_to_linear,
    tone_map,
)


def test_known_values():
    linear = torch.tensor([0.0, 0.001, 0.214041, 1.0], dtype=torch.float64)
    srgb = torch.tensor([0.0, 0.01292, 0.5, 1.0], dtype=torch.float64)
    assert linear_to_srgb(linear).allclose(srgb, atol=1e-6)
    assert srgb_to_linear(srgb).allclose(linear, atol=1e-6)


def test_round_trip_inside_and_outside_the_unit_interval():
    color = torch.linspace(-0.5, 4, 1001, dtype=torch.float64)
    assert srgb_to_linear(linear_to_srgb(color)).allclose(color, atol=2e-7)


@pytest.mark.parametrize("curve", [linear_to_srgb, srgb_to_linear])
def test_derivatives_of_the_curves_agree_with_differences(curve):
    color = torch.tensor([-1.0, 0.0, 1e-3, 0.1, 1.0, 5.0], dtype=torch.float64, requires_grad=True)
    assert torch.autograd.gradcheck(curve, color)


def test_a_response_is_the_identity_or_the_clipped_srgb_curve():
    color = torch.tensor([-1.0, 0.0, 0.25, 1.0, 7.0])
    assert torch.equal(apply_response(color, "linear"), color)
    # 1.055 · 0.25^(1/2.4) − 0.055 = 0.53710
    assert apply_response(color, "srgb").allclose(torch.tensor([0.0, 0.0, 0.53710, 1.0, 1.0]), atol=1e-5)
    assert torch.equal(tone_map(color), apply_response(color, "srgb"))


def test_display_values_are_clipped_in_either_response():
    pixel = torch.tensor([-1.0, 0.25, 7.0])
    assert display_values(pixel, "linear").allclose(torch.tensor([0.0, 0.53710, 1.0]), atol=1e-5)
    assert display_values(pixel, "srgb").tolist() == [0.0, 0.25, 1.0]


def test_an_undetermined_response_is_refused():
    with pytest.raises(UserError, match="choose linear or srgb"):
        apply_response(torch.zeros(3), "auto")


def test_luminance_has_the_weights_of_rec_709():
    assert luminance(torch.eye(3)).allclose(torch.tensor([0.2126, 0.7152, 0.0722]))
    assert luminance(torch.ones(2, 3)).allclose(torch.ones(2))


@pytest.mark.parametrize("response", ["linear", "srgb"])
def test_the_slope_of_a_response_is_its_derivative_by_log_radiance(response):
    radiance = torch.logspace(-5, -0.01, 200, dtype=torch.float64)
    logarithm = radiance.log().requires_grad_()
    pixel = apply_response(logarithm.exp(), response)
    (slope,) = torch.autograd.grad(pixel.sum(), logarithm)
    # The standard rounds the constants of its curve: at the knee the slopes of its two parts are 1.6 % apart.
    torch.testing.assert_close(response_slope(pixel.detach(), response), slope, rtol=1e-6, atol=0.0)


def test_a_clipped_pixel_is_a_lower_bound():
    radiance = torch.tensor([4.0, 0.2, 4.0, 0.5], requires_grad=True)
    pixel = torch.tensor([1.0, 1.0, 0.5, apply_response(torch.tensor(0.3), "srgb")])
    off = residual(radiance, pixel, "srgb")
    off.abs().sum().backward()
    off = off.detach()
    # At a clipped pixel, a brighter render has no loss and a darker one has. Elsewhere a too bright render
    # has a loss.
    assert off[0] == 0
    assert radiance.grad[0] == 0
    assert off[1] < -0.4
    assert radiance.grad[1] < 0
    assert off[2] == pytest.approx(1.055 * 4.0 ** (1 / 2.4) - 0.055 - 0.5)
    assert radiance.grad[2] > 0
    assert off[3] == pytest.approx(0.735357 - pixel[3].item(), abs=1e-5)


def test_radiance_has_no_upper_end():
    radiance, pixel = torch.tensor([4.0, 0.2]), torch.tensor([1.0, 1.0])
    assert torch.equal(residual(radiance, pixel, "linear"), radiance - pixel)


@pytest.mark.parametrize("response", ["linear", "srgb"])
def test_common_exposure_is_the_inverse_of_a_gain(response):
    radiance, gain = torch.tensor([0.01, 0.1, 0.4]), torch.tensor([0.5, 2.0, 1.5])
    taken = apply_response(radiance * gain, response)
    found = at_common_exposure(taken, gain, response)
    torch.testing.assert_close(found, apply_response(radiance, response))


def test_clipped_pixels_stay_lower_bounds_at_any_exposure():
    found = at_common_exposure(torch.tensor([1.0, 1.0]), torch.tensor([2.0, 0.5]), "srgb")
    assert found[0] == 1.0  # its lower bound is 0.5; as 1 it is still a lower bound
    assert found[1] == pytest.approx(1.055 * 2.0 ** (1 / 2.4) - 0.055)
    assert residual(torch.tensor(9.0), found[0], "srgb") == 0
