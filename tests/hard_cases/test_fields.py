"""Inputs at which fields tend to fail: values and all gradients are finite and bounded."""

from __future__ import annotations

import pytest
import torch

from neilfpp_method.fields.background import InvertedSphere
from neilfpp_method.fields.brdf import BrdfField
from neilfpp_method.fields.incident_light import IncidentLightField
from neilfpp_method.fields.outgoing_radiance import OutgoingRadianceField
from neilfpp_method.fields.sdf import SdfField
from neilfpp_method.settings.presets import free_light, preset
from neilfpp_method.settings.types import BackgroundConfig

# The origin, faces, edges and corners of the scene cube, vertices of the grid, far outside, almost nothing.
POSITIONS = torch.tensor(
    [
        [0.0, 0.0, 0.0],
        [1.75, 0.0, 0.0],
        [-1.75, -1.75, 0.0],
        [1.75, 1.75, 1.75],
        [1.75 / 8, 1.75 / 8, -1.75 / 8],
        [100.0, -100.0, 0.0],
        [1e6, 1e6, 1e6],
        [1e-30, 0.0, 1e-30],
    ]
)
DTYPES = [torch.float32, torch.float64, torch.bfloat16]


def assert_bounded(*tensors: torch.Tensor, bound: float = 1e9) -> None:
    for tensor in tensors:
        assert tensor.isfinite().all()
        assert tensor.abs().max() < bound


LIT = {"fast": free_light(preset("fast")), "paper-mlp": preset("paper-mlp")}


def gradients(loss: torch.Tensor, module: torch.nn.Module, *inputs: torch.Tensor) -> list[torch.Tensor]:
    targets = [*module.parameters(), *inputs]
    return list(torch.autograd.grad(loss, targets, allow_unused=True, materialize_grads=True))


@pytest.mark.parametrize("dtype", DTYPES)
@pytest.mark.parametrize("name", ["fast", "paper-mlp"])
def test_distances_and_their_gradients_are_bounded(name, dtype):
    torch.manual_seed(0)
    field = SdfField(preset(name).host.sdf, preset(name).encoding, 1.75).to(dtype)
    x = POSITIONS.to(dtype).requires_grad_()
    sample = field.with_gradient(x)
    assert sample.distance.dtype == sample.gradient.dtype == dtype
    loss = sample.distance.sum() + (sample.gradient.square().sum(1) - 1).abs().sum() + sample.feature.sum()
    assert_bounded(sample.distance, sample.gradient, sample.feature, *gradients(loss, field, x), bound=1e13)


@pytest.mark.parametrize("method", ["analytic", "finite_difference"])
@pytest.mark.parametrize("name", ["fast", "paper-mlp"])
def test_hessians_and_their_gradients_are_bounded(name, method):
    torch.manual_seed(0)
    field = SdfField(preset(name).host.sdf, preset(name).encoding, 1.75)
    hessian = field.hessian(POSITIONS[:6], method)
    assert_bounded(hessian, *gradients(hessian.abs().mean(), field))


@pytest.mark.parametrize("dtype", DTYPES)
@pytest.mark.parametrize("name", ["fast", "paper-mlp"])
def test_materials_and_their_gradients_are_bounded(name, dtype):
    torch.manual_seed(0)
    field = BrdfField(preset(name).brdf, preset(name).encoding, 1.75).to(dtype)
    x = POSITIONS[:6].to(dtype).requires_grad_()
    sample = field.with_gradients(x)
    loss = (
        sample.material.base_color.sum()
        + sample.roughness_gradient.square().sum()
        + sample.metallic_gradient.sum()
    )
    assert_bounded(sample.material.roughness, sample.roughness_gradient, *gradients(loss, field, x))


@pytest.mark.parametrize("dtype", DTYPES)
@pytest.mark.parametrize("name", ["fast", "paper-ngp"])
def test_outgoing_radiance(name, dtype):
    torch.manual_seed(0)
    config = preset(name)
    field = OutgoingRadianceField(config.radiance, config.encoding, 15, 1.75, 3.0).to(dtype)
    x = POSITIONS.to(dtype).requires_grad_()
    zero = torch.zeros_like(x)  # a zero normal and a zero direction
    color = field(x, zero, zero, torch.zeros(len(x), 15, dtype=dtype))
    assert_bounded(color, *gradients(color.sum(), field, x), bound=3e7)


@pytest.mark.parametrize("dtype", DTYPES)
@pytest.mark.parametrize("name", ["fast", "paper-mlp"])
def test_incident_radiance_is_positive_and_bounded(name, dtype):
    torch.manual_seed(0)
    field = IncidentLightField(LIT[name].light, LIT[name].encoding, 10.0, 1.0).to(dtype)
    x = POSITIONS[:6].to(dtype).requires_grad_()
    light = field.radiance(x, torch.eye(3, dtype=dtype).expand(6, 3, 3))
    assert light.min() > 0
    assert_bounded(light, *gradients(light.sum(), field, x))


@pytest.mark.parametrize("dtype", DTYPES)
@pytest.mark.parametrize("name", ["fast", "paper-mlp"])
def test_background_from_the_center_and_from_the_rim(name, dtype):
    """Rays from the origin, along a radius, along a tangent, and from a hair outside the sphere."""
    torch.manual_seed(0)
    field = InvertedSphere(BackgroundConfig(radius=3.0), preset(name).encoding, scale=3.0).to(dtype)
    origins = torch.tensor([[0.0, 0.0, 0.0], [2.9, 0.0, 0.0], [3.0, 0.0, 0.0], [3.01, 0.0, 0.0]], dtype=dtype)
    directions = torch.tensor(
        [[0.0, 0.0, 1.0], [-1.0, 0.0, 0.0], [0.0, 1.0, 0.0], [0.0, 1.0, 0.0]], dtype=dtype
    )
    origins.requires_grad_()
    color = field(origins, directions)
    assert_bounded(color, *gradients(color.sum(), field, origins))


def test_empty_batches():
    none = torch.zeros(0, 3)
    for encoding in ("fast", "paper-mlp"):
        sample = SdfField(preset(encoding).host.sdf, preset(encoding).encoding, 1.75).with_gradient(none)
        assert sample.gradient.shape == (0, 3)
    light = IncidentLightField(LIT["fast"].light, LIT["fast"].encoding, 10.0, 1.0)
    assert light.radiance(none, torch.zeros(0, 4, 3)).shape == (0, 4, 3)
