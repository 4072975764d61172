"""R: its start, its range, and what it depends on."""

from __future__ import annotations

import pytest
import torch

from neilfpp_method.fields.outgoing_radiance import OutgoingRadianceField
from neilfpp_method.presets import preset


def inputs(feature_width: int) -> list[torch.Tensor]:
    torch.manual_seed(1)
    wo, normal = (torch.nn.functional.normalize(torch.randn(50, 3)) for _ in range(2))
    return [torch.rand(50, 3), wo, normal, torch.randn(50, feature_width)]


@pytest.mark.parametrize("name", ["paper-mlp", "paper-ngp", "fast"])
@pytest.mark.parametrize(
    ("scale", "asked", "start"),
    [(1.0, 0.2, 0.2), (3.0, 0.2, 0.2), (0.1, 0.2, 0.05), (3e4, 2e3, 2e3), (3e-4, 2e-5, 2e-5)],
)
def test_starts_near_what_is_asked_and_below_its_scale(name, scale, asked, start):
    torch.manual_seed(0)
    config = preset(name)
    width = config.sdf.feature_width
    color = OutgoingRadianceField(config.radiance, width, config.volume.radius, scale, asked)(*inputs(width))
    assert color.shape == (50, 3)
    assert color.min() > 0
    assert color.max() < scale
    assert color.mean().item() == pytest.approx(start, rel=0.3)


def test_depends_on_all_that_it_is_given():
    torch.manual_seed(0)
    config = preset("paper-ngp")
    field = OutgoingRadianceField(config.radiance, 15, 3.0, 1.0)
    with torch.no_grad():
        field.position.table.normal_()
    given = [t.requires_grad_() for t in inputs(15)]
    for gradient in torch.autograd.grad(field(*given).sum(), given):
        assert (gradient.abs().amax(1) > 0).all()
