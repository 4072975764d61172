"""Softplus by compiled loops, compared with float64 and with autograd of torch's softplus."""

from __future__ import annotations

import math

import pytest
import torch

from neilfpp_method.kernels.softplus import softplus, softplus_and_slope

SHARPNESSES = (1.0, 100.0)


def numbers(count: int = 4001) -> torch.Tensor:
    """From far below to far above the bend of both sharpnesses."""
    return torch.cat((torch.linspace(-1.0, 1.0, count), torch.linspace(-60.0, 60.0, count)))


def exact(z: torch.Tensor, sharpness: float) -> torch.Tensor:
    return torch.logaddexp(torch.zeros((), dtype=torch.float64), sharpness * z.double()) / sharpness


@pytest.mark.parametrize("sharpness", SHARPNESSES)
def test_value_and_slope_are_exact_to_the_last_digits(sharpness):
    z = numbers()
    units = softplus_and_slope(z, sharpness)
    scale = z.double().abs().clamp_min(1.0 / sharpness)
    assert ((units.value - exact(z, sharpness)) / scale).abs().max() < 1.5e-7
    assert (units.slope - torch.sigmoid(sharpness * z.double())).abs().max() < 1.5e-7
    torch.testing.assert_close(softplus(z, sharpness), units.value, rtol=0.0, atol=0.0)


@pytest.mark.parametrize("sharpness", SHARPNESSES)
def test_gradients_of_first_and_second_order_agree_with_float64(sharpness):
    """The gradient of a loss on value and slope, and the gradient of that gradient."""

    def orders(z: torch.Tensor) -> list[torch.Tensor]:
        z = z.requires_grad_()
        units = softplus_and_slope(z, sharpness)
        loss = (units.value.sin() + (units.slope * 3.0).cos()).sum()
        (first,) = torch.autograd.grad(loss, z, retain_graph=True)
        (again,) = torch.autograd.grad(loss, z, create_graph=True)
        (second,) = torch.autograd.grad(again.square().sum(), z)
        return [first, again.detach(), second]

    z = 0.5 * torch.randn(999, generator=torch.Generator().manual_seed(0)) / sharpness
    for ours, expected in zip(orders(z.clone()), orders(z.double()), strict=True):
        torch.testing.assert_close(
            ours.double(), expected, rtol=1e-4, atol=2e-6 * expected.abs().max().item()
        )


def test_the_gradient_of_only_the_value():
    z = numbers().requires_grad_()
    softplus(z, 100.0).sum().backward()
    torch.testing.assert_close(
        z.grad.double(), torch.sigmoid(100.0 * z.detach().double()), rtol=0.0, atol=1.5e-7
    )


def test_nan_stays_nan():
    units = softplus_and_slope(torch.tensor([math.nan, math.inf, -math.inf, 0.0]), 100.0)
    assert units.value[0].isnan()
    assert units.slope[0].isnan()
    assert units.value[1] == math.inf
    assert units.slope[1] == 1.0
    assert 0.0 <= units.value[2] < 1e-18
    assert 0.0 <= units.slope[2] < 1e-16
    assert units.slope[3] == 0.5


@pytest.mark.parametrize("shape", [(0, 8), (1,), (3, 5, 7), ()])
def test_every_shape_is_kept(shape):
    z = torch.randn(shape)
    torch.testing.assert_close(softplus(z, 10.0).double(), exact(z, 10.0), rtol=1e-6, atol=1e-7)
    assert softplus(z, 10.0).shape == z.shape


def test_any_order_in_memory():
    z = torch.randn(6, 4).t()
    torch.testing.assert_close(
        softplus_and_slope(z, 10.0).value.double(), exact(z, 10.0), rtol=1e-6, atol=1e-7
    )


def test_several_threads_compute_the_same():
    z = torch.randn(300_001)
    one = softplus(z, 100.0)
    before = torch.get_num_threads()
    torch.set_num_threads(3)
    try:
        assert torch.equal(softplus(z, 100.0), one)
    finally:
        torch.set_num_threads(before)


@pytest.mark.parametrize("dtype", [torch.float16, torch.bfloat16, torch.float64])
def test_other_types_agree_to_their_precision(dtype):
    z = torch.randn(64).to(dtype)
    torch.testing.assert_close(softplus(z, 10.0).double(), exact(z, 10.0), rtol=1e-2, atol=1e-2)
