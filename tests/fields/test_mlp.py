"""Networks: the explicit reverse pass compared with autograd, and the initial weights."""

from __future__ import annotations

import numpy as np
import pytest
import torch

from neilfpp_method.errors import UserError
from neilfpp_method.fields.mlp import Mlp, weight_normalize_

SHAPES = [("softplus", None), ("softplus", 2), ("relu", 1), ("sine", 3), ("sine", 2)]


def network(activation: str, skip: int | None) -> Mlp:
    torch.manual_seed(0)
    mlp = Mlp(5, 4, layers=3, width=8, activation=activation, skip=skip)
    weight_normalize_(mlp)
    return mlp.double()


def inputs() -> torch.Tensor:
    return torch.randn(7, 5, dtype=torch.float64, generator=torch.Generator().manual_seed(1))


def gradient_by_autograd(mlp: Mlp, x: torch.Tensor, outputs: slice) -> torch.Tensor:
    values = mlp(x)[:, outputs].sum(0)
    return torch.stack([torch.autograd.grad(value, x, create_graph=True)[0] for value in values], 1)


@pytest.mark.parametrize(("activation", "skip"), SHAPES)
def test_gradient_agrees_with_autograd(activation, skip):
    mlp, x = network(activation, skip), inputs().requires_grad_()
    sample = mlp.with_gradient(x, slice(1, 3))
    torch.testing.assert_close(sample.value, mlp(x))
    torch.testing.assert_close(sample.gradient, gradient_by_autograd(mlp, x, slice(1, 3)))


@pytest.mark.parametrize(("activation", "skip"), SHAPES)
def test_a_loss_on_the_gradient_agrees_with_double_backward(activation, skip):
    mlp, x = network(activation, skip), inputs().requires_grad_()
    parameters = [*mlp.parameters(), x]

    def gradients(of):
        return torch.autograd.grad(of.square().sum(), parameters, allow_unused=True, materialize_grads=True)

    ours = gradients(mlp.with_gradient(x, slice(0, 1)).gradient)
    expected = gradients(gradient_by_autograd(mlp, x, slice(0, 1)))
    for a, b in zip(ours, expected, strict=True):
        torch.testing.assert_close(a, b, rtol=1e-5, atol=1e-7)  # torch cuts softplus off where e^−20 is left


def test_chosen_outputs_are_those_of_the_whole():
    mlp = network("softplus", 2)
    torch.testing.assert_close(mlp(inputs(), slice(1, 2)), mlp(inputs())[:, 1:2])


def test_forward_of_two_units_by_hand():
    mlp = Mlp(1, 1, layers=1, width=2, activation="relu", skip=1)
    with torch.no_grad():
        mlp.layers[0].weight.copy_(torch.tensor([[2.0], [-1.0]]))
        mlp.layers[0].bias.copy_(torch.tensor([0.5, 0.25]))
        mlp.layers[1].weight.copy_(torch.tensor([[3.0, 5.0, 7.0]]))
        mlp.layers[1].bias.fill_(0.125)
    # hidden: relu(2·0.5 + 0.5) = 1.5 and relu(−0.5 + 0.25) = 0; the input 0.5 enters again
    assert mlp(torch.tensor([[0.5]])).item() == 3 * 1.5 + 5 * 0 + 7 * 0.5 + 0.125


def test_sine_layers_keep_their_distribution():
    """SIREN's theorem: at any depth the units are distributed like the sine of a uniform phase, with variance
    ½.
    """
    torch.manual_seed(0)
    mlp = Mlp(8, 3, layers=6, width=256, activation="sine")
    assert 0.9 / 8 < mlp.layers[0].weight.abs().max() <= 1 / 8
    hidden = torch.rand(1000, 8) * 2 - 1
    for layer in mlp.layers[:-1]:
        hidden = mlp.activation.value(layer(hidden))
        assert hidden.std().item() == pytest.approx(np.sqrt(0.5), rel=0.1)


def test_weight_normalization_keeps_the_function():
    torch.manual_seed(0)
    mlp = Mlp(5, 4, layers=3, width=8, activation="softplus").double()
    before = mlp(inputs())
    weight_normalize_(mlp)
    torch.testing.assert_close(mlp(inputs()), before)
    assert sum(p.numel() for p in mlp.parameters()) == (5 * 8 + 2 * 8 * 8 + 8 * 4) + 2 * (3 * 8 + 4)


@pytest.mark.parametrize(("layers", "skip"), [(0, None), (2, 3), (2, 0)])
def test_an_invalid_network_is_refused(layers, skip):
    with pytest.raises(UserError, match="skip"):
        Mlp(3, 1, layers=layers, width=4, activation="relu", skip=skip)
