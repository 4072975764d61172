"""B: its initial value, its range and its gradients."""

from __future__ import annotations

import pytest
import torch

from neilfpp_method.fields.brdf import BrdfField
from neilfpp_method.settings.presets import preset
from neilfpp_method.settings.types import BrdfConfig, FrequencyConfig, HashGridConfig
from tests.scenes import positions

SMALL = {
    "sine": (BrdfConfig(layers=4, width=16), FrequencyConfig()),
    "hash": (BrdfConfig(layers=2, width=16), HashGridConfig(levels=3, log2_entries=9, max_resolution=32)),
}


@pytest.mark.parametrize("name", ["paper-mlp", "paper-ngp", "fast"])
def test_starts_at_the_configured_material(name):
    torch.manual_seed(0)
    config = preset(name)
    material = BrdfField(config.brdf, config.encoding, config.background.radius)(positions(200).float())
    starts = {
        "base_color": (3, config.brdf.initial_base_color),
        "roughness": (1, 0.5),
        "metallic": (1, config.brdf.initial_metallic),
    }
    for name, (width, start) in starts.items():
        values = getattr(material, name)
        assert values.shape == (200, width)
        assert (values - start).abs().max() < 0.05, name


@pytest.mark.parametrize("kind", SMALL)
def test_gradients_agree_with_autograd(kind):
    torch.manual_seed(0)
    field, x = BrdfField(*SMALL[kind], 1.75).double(), positions().requires_grad_()
    with torch.no_grad():
        field.mlp.layers[-1].weight.mul_(50)  # away from grey, where tanh bends
    sample = field.with_gradients(x)
    for name in ("base_color", "roughness", "metallic"):
        torch.testing.assert_close(getattr(sample.material, name), getattr(field(x), name))
    for name in ("roughness", "metallic"):
        expected = torch.autograd.grad(getattr(field(x), name).sum(), x)[0]
        assert expected.abs().max() > 1e-4
        torch.testing.assert_close(getattr(sample, f"{name}_gradient"), expected)


@pytest.mark.parametrize("kind", SMALL)
def test_range_holds_for_any_output(kind):
    field = BrdfField(*SMALL[kind], 1.75)
    with torch.no_grad():
        field.mlp.layers[-1].weight.normal_(std=1e3)
    material = field(positions(100).float())
    for values in (material.base_color, material.roughness, material.metallic):
        assert values.min() >= 0
        assert values.max() <= 1


@pytest.mark.parametrize("factor", [0.8, 1.3, 40.0])
def test_base_colors_are_scaled_up_to_1(factor):
    field, x = BrdfField(*SMALL["hash"], 1.75), positions(100).float()
    with torch.no_grad():
        field.mlp.layers[-1].weight.normal_()
        before = field(x)
        field.scale_base_color(factor)
        after = field(x)
    torch.testing.assert_close(after.base_color, (factor * before.base_color).clamp_max(1.0))
    assert torch.equal(after.roughness, before.roughness)
    assert torch.equal(after.metallic, before.metallic)
    copy = BrdfField(*SMALL["hash"], 1.75)
    copy.load_state_dict(field.state_dict())
    assert torch.equal(copy(x).base_color, after.base_color)
