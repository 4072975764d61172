"""R: its initial value, its range, and the inputs that it depends on."""

from __future__ import annotations

import pytest
import torch

from neilfpp_method.fields.outgoing_radiance import OutgoingRadianceField
from neilfpp_method.settings.presets import preset


def inputs(feature_width: int) -> list[torch.Tensor]:
    torch.manual_seed(1)
    wo, normal = (torch.nn.functional.normalize(torch.randn(50, 3)) for _ in range(2))
    return [torch.rand(50, 3), wo, normal, torch.randn(50, feature_width)]


@pytest.mark.parametrize("name", ["paper-mlp", "paper-ngp", "fast"])
@pytest.mark.parametrize(
    ("scale", "asked", "start"),
    [(1.0, 0.2, 0.2), (3.0, 0.2, 0.2), (0.1, 0.2, 0.05), (3e4, 2e3, 2e3), (3e-4, 2e-5, 2e-5)],
)
def test_starts_near_the_given_radiance_and_below_its_scale(name, scale, asked, start):
    torch.manual_seed(0)
    config = preset(name)
    width = config.host.sdf.feature_width
    color = OutgoingRadianceField(
        config.radiance, config.encoding, width, config.background.radius, scale, asked
    )(*inputs(width))
    assert color.shape == (50, 3)
    assert color.min() > 0
    assert color.max() < scale
    assert color.mean().item() == pytest.approx(start, rel=0.3)


@pytest.mark.parametrize("name", ["paper-ngp", "fast"])
def test_depends_on_all_inputs(name):
    torch.manual_seed(0)
    config = preset(name)
    field = OutgoingRadianceField(config.radiance, config.encoding, 15, 3.0, 1.0)
    with torch.no_grad():
        for table in field.position.parameters():
            table.normal_()
    given = [t.requires_grad_() for t in inputs(15)]
    for gradient in torch.autograd.grad(field(*given).sum(), given):
        assert (gradient.abs().amax(1) > 0).all()


def test_the_mirrored_direction_is_that_of_a_mirror():
    torch.manual_seed(0)
    field = OutgoingRadianceField(preset("fast").radiance, preset("fast").encoding, 15, 3.0, 1.0).double()
    x, wo, normal, feature = (t.double() for t in inputs(15))
    wo, normal = (torch.nn.functional.normalize(t, dim=-1) for t in (wo, normal))
    seen = {}
    field.direction.register_forward_hook(lambda module, given, encoded: seen.update(direction=given[0]))
    field(x, wo, normal, feature)
    half = torch.nn.functional.normalize(wo + seen["direction"], dim=-1)
    torch.testing.assert_close(seen["direction"].norm(dim=-1), torch.ones(50).double())
    torch.testing.assert_close(
        (half * normal).sum(-1).abs(), torch.ones(50).double()
    )  # the normal halves the angle


def test_derivatives_of_a_mirrored_direction():
    torch.manual_seed(0)
    field = OutgoingRadianceField(preset("fast").radiance, preset("fast").encoding, 2, 3.0, 1.0).double()
    x, wo, normal, feature = (t[:4].double() for t in inputs(2))
    wo, normal = wo.requires_grad_(), normal.requires_grad_()
    assert torch.autograd.gradcheck(lambda wo, normal: field(x, wo, normal, feature), (wo, normal))
