"""The light that training starts with, and the lobe, at places whose light and material are made up."""

from __future__ import annotations

import math

import pytest
import torch

from neilfpp_method.effects.first_light import MIN_PLACES, FirstLight, _lowest, find_first_light, start_with
from neilfpp_method.effects.lobes import lobe_evidence
from neilfpp_method.effects.place_fit import ROWS, fit_places, place_transport
from neilfpp_method.effects.places import Places
from neilfpp_method.fields.brdf import BrdfField
from neilfpp_method.model import NeilfModel
from neilfpp_method.settings.facts import SceneFacts
from neilfpp_method.settings.presets import preset
from neilfpp_method.shading import LOBES
from tests.effects.balls import ball, sky

COUNT = 160


def patched(lobe: str, bright: float = 1.0) -> Places:
    """Half paint, half metal, in colours and roughnesses of their own."""
    torch.manual_seed(1)
    base_color = bright * (0.2 + 0.6 * torch.rand(COUNT, 3))
    roughness = torch.tensor([0.2, 0.36, 0.66]).repeat(COUNT)[:COUNT, None]
    metallic = (torch.arange(COUNT) % 2)[:, None].float()
    return ball(base_color, roughness, metallic, LOBES[lobe])


def log_distance(log_radiance: torch.Tensor) -> float:
    """Mean error of the logarithm of the map, by solid angle."""
    off = (log_radiance - sky().log_radiance).abs().mean(0).flatten()
    weight = sky().texel_directions(torch.zeros(1, 3)).solid_angle
    return ((off * weight).sum() / weight.sum()).item()


@pytest.mark.parametrize("bright", [1.0, 0.4])
def test_scale_and_map_are_found_where_a_free_fit_keeps_the_scale_that_it_starts_with(bright):
    places, lobe = patched("ggx", bright), LOBES["ggx"]
    typical = places.observed.pixel.median().item()
    found = find_first_light(places, lobe, None, typical, metals=True)
    torch.manual_seed(1)
    truth = (bright * (0.2 + 0.6 * torch.rand(COUNT, 3))).log().mean().exp().item()
    assert abs(math.log(found.scale / truth)) < math.log(1.35)
    free = fit_places(places, place_transport(places, lobe, None), typical, metals=True)
    assert log_distance(found.log_radiance) < max(0.35, log_distance(free.log_radiance))
    assert found.places == COUNT
    assert "160 places" in found.in_words()


def test_views_kept_back_tell_the_lobe_that_the_images_were_made_with():
    for lobe, sign in (("ggx", 1), ("spherical_gaussian", -1)):
        places = patched(lobe)
        gain = lobe_evidence(places, None, places.observed.pixel.median().item(), metals=True)
        assert sign * gain.value > 2 * gain.deviation > 0


def test_a_handful_of_places_is_no_ground_for_a_light():
    places = patched("ggx")
    few = places.where(torch.nonzero(places.place < MIN_PLACES - 1)[:, 0])
    assert find_first_light(few, LOBES["ggx"], None, 1.0, metals=True) is None


def test_lowest_is_the_foot_of_the_parabola_over_the_logarithm():
    def errors(foot: float) -> dict[float, float]:
        return {s: math.log(s / foot) ** 2 for s in (0.1, 0.15, 0.22, 0.33, 0.5, 0.7)}

    assert _lowest(errors(0.27)) == pytest.approx(0.27)
    assert _lowest(errors(0.05)) == 0.1  # at an end: no further
    assert _lowest(errors(0.9)) == 0.7


def test_an_untrained_field_starts_at_the_base_color_that_was_found():
    config = preset("fast")
    field = BrdfField(config.brdf, config.encoding, 1.0)
    color = torch.tensor([0.6, 0.3, 0.1])
    field.start_at(color)
    torch.testing.assert_close(field(torch.zeros(1, 3)).base_color[0], color, atol=0.02, rtol=0)


def test_a_model_takes_the_map_that_was_found():
    model = NeilfModel(Ball(), preset("fast"), SceneFacts("linear", 0.3, 3.0, "constant"))
    found = FirstLight(sky().log_radiance, torch.full((3,), 0.5), {0.33: 0.1}, 0.33, COUNT)
    start_with(model, found)
    coarse = model.light.at_most(ROWS).log_radiance
    assert (coarse - sky().log_radiance).abs().median() < 0.1
