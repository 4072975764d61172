"""G: its initial value, its gradient and its Hessian."""

from __future__ import annotations

import pytest
import torch

from neilfpp_method.fields.sdf import SdfField
from neilfpp_method.settings.presets import preset
from neilfpp_method.settings.types import FrequencyConfig, HashGridConfig, SdfConfig
from tests.scenes import positions

GRID = HashGridConfig(levels=3, sdf_log2_entries=9, max_resolution=32)
SMALL = {
    "frequency": (SdfConfig(layers=4, width=16, feature_width=4), FrequencyConfig()),
    "hash": (SdfConfig(layers=2, width=16, feature_width=4), GRID),
}
METHODS = ["analytic", "finite_difference"]


def worn_in(encoding: str, noise: float = 0.1) -> SdfField:
    """A field away from its initial value, in float64, so that every parameter has an influence."""
    torch.manual_seed(0)
    field = SdfField(*SMALL[encoding], radius=1.75).double()
    with torch.no_grad():
        for parameter in field.parameters():
            parameter += noise * torch.randn_like(parameter)
    return field


@pytest.mark.parametrize("name", ["paper-mlp", "paper-ngp", "fast"])
def test_starts_as_a_sphere(name):
    torch.manual_seed(0)
    config = preset(name)
    field = SdfField(config.host.sdf, config.encoding, config.background.radius)
    directions = torch.nn.functional.normalize(torch.randn(500, 3))
    for radius, error in ((0.1, 0.15), (0.3, 0.1), (0.6, 0.06), (1.0, 0.08), (1.75, 0.15)):
        with torch.no_grad():
            sample = field.with_gradient(radius * directions)
        assert (sample.distance - (radius - 0.6)).abs().max() < error
        if radius >= 0.3:
            assert (sample.gradient.norm(dim=1).mean() - 1).abs() < 0.25
            assert (sample.gradient * directions).sum(1).min() > 0.5


@pytest.mark.parametrize("encoding", SMALL)
def test_gradient_agrees_with_autograd_and_with_differences(encoding):
    field, x = worn_in(encoding), positions().requires_grad_()
    sample = field.with_gradient(x)
    torch.testing.assert_close(sample.distance, field(x))
    torch.testing.assert_close(sample.gradient, torch.autograd.grad(field(x).sum(), x)[0])
    steps = 1e-6 * torch.eye(3, dtype=torch.float64)
    differences = torch.stack([(field(x + s) - field(x - s)) / 2e-6 for s in steps], -1)
    torch.testing.assert_close(sample.gradient, differences, rtol=1e-5, atol=1e-5)


@pytest.mark.parametrize("encoding", SMALL)
def test_eikonal_gradients_agree_with_double_backward(encoding):
    field, x = worn_in(encoding), positions().requires_grad_()
    parameters = list(field.parameters())

    def gradients(of):
        loss = (of.norm(dim=1) - 1).abs().mean()
        return torch.autograd.grad(loss, parameters, allow_unused=True, materialize_grads=True)

    ours = gradients(field.with_gradient(x).gradient)
    expected = gradients(torch.autograd.grad(field(x).sum(), x, create_graph=True)[0])
    assert all(p.abs().max() > 0 for p in ours[:1])
    for a, b in zip(ours, expected, strict=True):
        torch.testing.assert_close(a, b, rtol=1e-6, atol=1e-6)


@pytest.mark.parametrize("encoding", SMALL)
def test_analytic_hessian_agrees_with_differences_of_the_gradient(encoding):
    field, x = worn_in(encoding), positions()
    steps = 1e-6 * torch.eye(3, dtype=torch.float64)
    gradient = lambda at: field.with_gradient(at).gradient  # noqa: E731
    expected = torch.stack([(gradient(x + s) - gradient(x - s)) / 2e-6 for s in steps], -1)
    hessian = field.hessian(x, "analytic")
    torch.testing.assert_close(hessian, expected, rtol=1e-4, atol=1e-3)
    torch.testing.assert_close(hessian, hessian.transpose(1, 2), rtol=1e-6, atol=1e-6)


def test_both_hessians_agree_on_a_smooth_field():
    """Forward differences are off by step/2 times the third derivative: a few per cent here."""
    field, x = worn_in("frequency", noise=0.02), positions(50)
    analytic, difference = (field.hessian(x, method) for method in METHODS)
    assert (difference - analytic).abs().mean() < 0.05 * analytic.abs().mean()


@pytest.mark.parametrize("method", METHODS)
@pytest.mark.parametrize("encoding", SMALL)
def test_a_loss_on_the_hessian_reaches_the_parameters(encoding, method):
    """The slope of the loss along its own gradient is the gradient's squared length."""
    field, x = worn_in(encoding), positions(4)
    parameters = list(field.parameters())
    loss = lambda: field.hessian(x, method).square().mean()  # noqa: E731
    gradients = torch.autograd.grad(loss(), parameters, allow_unused=True, materialize_grads=True)
    squared = sum(g.square().sum() for g in gradients)
    values = []
    for step in (-1e-6, 1e-6):
        with torch.no_grad():
            for p, g in zip(parameters, gradients, strict=True):
                p += step * g / squared.sqrt()
        values.append(loss().item())
        with torch.no_grad():
            for p, g in zip(parameters, gradients, strict=True):
                p -= step * g / squared.sqrt()
    assert (values[1] - values[0]) / 2e-6 == pytest.approx(squared.sqrt().item(), rel=1e-3)


def test_hessian_without_gradients_builds_no_graph():
    with torch.no_grad():
        assert not worn_in("hash").hessian(positions(), "analytic").requires_grad
