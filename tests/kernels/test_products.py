"""Products with three columns, and their gradients, compared with plain products in float64."""

from __future__ import annotations

import itertools

import pytest
import torch

from neilfpp_method.kernels import products
from neilfpp_method.kernels.products import times_channels

SHAPES = ((1, 1), (3, 7), (4, 5), (2, 6, 9), (3, 50, 40), (0, 4), (5, 0))


def factors(shape: tuple[int, ...], dtype: torch.dtype = torch.float32) -> tuple[torch.Tensor, torch.Tensor]:
    torch.manual_seed(0)
    return torch.randn(shape, dtype=dtype), torch.randn(shape[-1], 3, dtype=dtype)


@pytest.mark.parametrize("shape", SHAPES)
@pytest.mark.parametrize("with_loops", [True, False])
def test_products_and_gradients_are_those_of_float64(shape, with_loops, monkeypatch):
    if not with_loops:
        monkeypatch.setattr(products, "loops", lambda: None)
    matrix, channels = (values.requires_grad_() for values in factors(shape))
    product = times_channels(matrix, channels)
    weight = torch.randn(product.shape)
    gradients = torch.autograd.grad((weight * product).sum(), (matrix, channels))
    in_double = [values.detach().double().requires_grad_() for values in (matrix, channels)]
    exact = in_double[0] @ in_double[1]
    expected = torch.autograd.grad((weight * exact).sum(), in_double)
    for ours, theirs in zip((product, *gradients), (exact, *expected), strict=True):
        torch.testing.assert_close(ours.double(), theirs.detach(), rtol=1e-5, atol=1e-5)


@pytest.mark.parametrize("shape", SHAPES)
def test_gradients_in_double_precision(shape):
    matrix, channels = (values.requires_grad_() for values in factors(shape, torch.float64))
    assert torch.autograd.gradcheck(times_channels, (matrix, channels))


def test_threads_divide_the_rows(monkeypatch):
    """Every row counts once, for any number of ranges."""
    matrix, channels = factors((23, 11))
    expected = matrix.t() @ torch.ones(23, 3)
    for edges in ((0, 23), (0, 5, 23), (0, 8, 16, 23)):
        ranges = list(itertools.pairwise(edges))
        monkeypatch.setattr(products, "shares", lambda *_, ranges=ranges: ranges)
        channels = channels.detach().requires_grad_()
        times_channels(matrix, channels).sum().backward()
        torch.testing.assert_close(channels.grad, expected)


def test_a_matrix_that_needs_no_gradient_gets_none():
    matrix, channels = factors((4, 5))
    channels.requires_grad_()
    times_channels(matrix, channels).sum().backward()
    assert matrix.grad is None
    torch.testing.assert_close(channels.grad, matrix.sum(0)[:, None].expand(-1, 3))
