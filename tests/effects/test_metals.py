"""Places that many views show: whether paint or metal explains them, where the truth is made up."""

from __future__ import annotations

import torch

from neilfpp_method.effects.metals import WORTH
from neilfpp_method.effects.place_fit import METALLICS, fit_places, place_errors, place_transport
from neilfpp_method.effects.places import Places
from neilfpp_method.fields.brdf import BrdfField
from neilfpp_method.fields.environment import EnvironmentLight
from neilfpp_method.lighting.transport import from_texels, from_texels_at
from neilfpp_method.settings.presets import preset
from neilfpp_method.shading import LOBES
from neilfpp_method.structures import Observed
from tests.effects.balls import ball

LOBE = LOBES["spherical_gaussian"]
PLACES, VIEWS = 40, 9


def ball_of(metallic: float) -> Places:
    """A ball of one material."""
    one = torch.ones(PLACES, 1)
    return ball(torch.tensor([[0.6, 0.5, 0.4]]).expand(PLACES, 3), 0.28 * one, metallic * one, LOBE, VIEWS)


def gain_of_metals(places: Places) -> tuple[float, float]:
    """Mean error that metals save in views that are kept back, and the share of places that are then of
    metal.
    """
    transport = place_transport(places, LOBE, None)
    typical = places.observed.pixel.median().item()
    back = places.view % 3 == 0
    known, kept = torch.nonzero(~back)[:, 0], torch.nonzero(back)[:, 0]
    paint, metal = (
        fit_places(places.where(known), transport[known], typical, metals) for metals in (False, True)
    )
    errors = [
        place_errors(fit, places.where(kept), transport[kept], typical).mean().item()
        for fit in (paint, metal)
    ]
    assert paint.metallic.max() == 0
    return errors[0] - errors[1], (metal.metallic > len(METALLICS) // 2).float().mean().item()


def test_metal_explains_views_kept_back_of_a_metal_ball_and_not_of_a_painted_one():
    of_metal, share = gain_of_metals(ball_of(1.0))
    of_paint, share_of_paint = gain_of_metals(ball_of(0.0))
    assert of_metal > 2 * WORTH
    assert share > 0.2  # the dark side of the sky tells little
    assert of_paint < 0.2 * WORTH
    assert share_of_paint == 0


def test_several_roughnesses_are_traced_once_and_are_what_each_is_alone():
    observed = ball_of(0.0).observed[:20]
    environment = EnvironmentLight(8, 1.0)
    torch.manual_seed(3)
    both = from_texels_at(environment, observed, (0.3, 0.7), LOBE, None)
    for k, roughness in enumerate((0.3, 0.7)):
        torch.manual_seed(3)
        alone = from_texels(environment, observed, torch.full((20, 1), roughness), LOBE, None)
        layers = both.sources[[0, 1 + 2 * k, 2 + 2 * k]].float()
        torch.testing.assert_close(layers, alone.sources, rtol=2e-3, atol=1e-4)


def test_without_metals_metallic_is_zero_and_learns_nothing():
    config = preset("fast")
    field = BrdfField(config.brdf, config.encoding, 1.0)
    x = torch.rand(5, 3)
    assert field(x).metallic.min() > 0
    field.metals = False
    sample = field.with_gradients(x)
    assert sample.material.metallic.max() == 0
    assert sample.metallic_gradient.abs().max() == 0
    field(x).metallic.sum().backward() if field(x).metallic.requires_grad else None
    assert field(x).roughness.requires_grad
    assert field.mlp.layers[-1].bias.grad is None or field.mlp.layers[-1].bias.grad[4] == 0


def test_means_are_of_each_place():
    values = torch.tensor([1.0, 3.0, 5.0])
    nothing = Observed(*[torch.zeros(3, 3)] * 4)
    places = Places(3, torch.tensor([0, 0, 2]), torch.arange(3), nothing)
    assert places.mean(values).tolist() == [2.0, 0.0, 5.0]
    assert places.where(torch.tensor([1])).mean(values[1:2]).tolist() == [3.0, 0.0, 0.0]
