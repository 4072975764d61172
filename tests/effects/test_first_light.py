"""The initial light and the lobe, at places with synthetic light and material."""

from __future__ import annotations

import math

import pytest
import torch

from neilfpp_method.effects.evidence.alternatives import Alternatives
from neilfpp_method.effects.evidence.lobes import lobe_evidence
from neilfpp_method.effects.evidence.metals import metals_evidence
from neilfpp_method.effects.first_light import MIN_PLACES, find_first_light
from neilfpp_method.effects.measurement import Measurement
from neilfpp_method.effects.places.data import ROWS
from neilfpp_method.effects.places.fit import Permitted, fit_places
from neilfpp_method.effects.places.gathering import Places
from neilfpp_method.fields.brdf import BrdfField
from neilfpp_method.settings.facts import SceneFacts
from neilfpp_method.settings.presets import preset
from neilfpp_method.shading import LOBES
from neilfpp_method.structures import Material
from tests.effects.balls import ball, data_of, sky

COUNT, VIEWS = 110, 7


def patched(lobe: str) -> Places:
    """Half paint, half metal, with varying colours and roughness."""
    torch.manual_seed(1)
    base_color = 0.2 + 0.6 * torch.rand(COUNT, 3)
    roughness = torch.tensor([0.2, 0.36, 0.66]).repeat(COUNT)[:COUNT, None]
    metallic = (torch.arange(COUNT) % 2)[:, None].float()
    return ball(base_color, roughness, metallic, LOBES[lobe], VIEWS)


def log_distance(log_radiance: torch.Tensor) -> float:
    """Mean error of the logarithm of the map, weighted by solid angle."""
    off = (log_radiance - sky().log_radiance).abs().mean(0).flatten()
    weight = sky().texel_directions(torch.zeros(1, 3)).solid_angle
    return ((off * weight).sum() / weight.sum()).item()


def test_scale_and_map_are_found_together():
    data = data_of(patched("ggx"), LOBES["ggx"])
    found = find_first_light(data, metals=True)
    torch.manual_seed(1)
    truth = (0.2 + 0.6 * torch.rand(COUNT, 3)).log().mean().exp().item()
    assert abs(math.log(found.scale / truth)) < math.log(1.35)
    start = torch.full((3, ROWS, 2 * ROWS), math.log(data.typical / truth))
    assert log_distance(found.fit.log_radiance) < 0.6 * log_distance(start)
    assert f"{COUNT} places" in found.summary()


def test_places_without_pixels_do_not_change_the_scale():
    """When they counted, the mean of the others was 0.99 in place of 0.2."""
    lobe, grey = LOBES["ggx"], torch.full((120, 3), 0.5)
    data = data_of(ball(grey, grey[:, :1], 0 * grey[:, :1], lobe), lobe)
    kept = data.where(torch.nonzero(data.places.place % 3 == 0)[:, 0])
    fit = fit_places(kept, Permitted(metals=False, mean_base_color=0.2), rounds=3)
    mean = fit.base_color[kept.places.place.unique()].log().mean().exp().item()
    assert mean == pytest.approx(0.2, rel=0.1)


def alternatives_of(places: Places, response: str = "linear") -> Alternatives:
    return Alternatives(
        places, None, SceneFacts(response, places.observed.pixel.median().item(), 3.0, "constant")
    )


def test_held_back_views_identify_the_lobe_of_the_images():
    # With half as many places the result depended on rounding, so on the processor.
    torch.manual_seed(0)
    color, ones = 0.2 + 0.6 * torch.rand(120, 3), torch.ones(120, 1)

    def gain(lobe: str) -> Measurement:
        places = ball(color, 0.36 * ones, ones, LOBES[lobe], views=16)
        return lobe_evidence(alternatives_of(places), metals=True)

    of_ggx, of_gaussian = gain("ggx"), gain("spherical_gaussian")
    assert of_ggx.value > 2 * of_ggx.deviation
    assert of_gaussian.value < 2 * of_gaussian.deviation
    assert of_gaussian.value < 0.7 * of_ggx.value


def test_held_back_views_distinguish_metals_from_paint():
    lobe = LOBES["ggx"]

    def gain(places: Places, response: str = "linear") -> Measurement:
        return metals_evidence(alternatives_of(places, response), "ggx")

    mixed = gain(patched("ggx"))
    assert mixed.favours(chosen=True)
    assert mixed.value > 2 * mixed.deviation
    assert mixed.samples == COUNT
    photographed = gain(patched("ggx"), "srgb")
    assert photographed.threshold > mixed.threshold
    torch.manual_seed(1)
    color, roughness = 0.2 + 0.6 * torch.rand(COUNT, 3), torch.full((COUNT, 1), 0.36)
    paint = gain(ball(color, roughness, torch.zeros(COUNT, 1), lobe, VIEWS))
    assert paint.value < 2 * paint.deviation


def test_too_few_places_give_no_initial_light():
    places = patched("ggx")
    few = places.where(torch.nonzero(places.place < MIN_PLACES - 1)[:, 0])
    assert find_first_light(data_of(few, LOBES["ggx"]), metals=True) is None


def test_an_untrained_field_starts_at_the_estimated_material():
    config = preset("fast")
    field = BrdfField(config.brdf, config.encoding, 1.0)
    color = torch.tensor([[0.6, 0.3, 0.1]])
    field.start_at(Material(color, torch.tensor([[0.4]]), torch.tensor([[0.0]])))
    started = field(torch.zeros(1, 3))
    torch.testing.assert_close(started.base_color, color, atol=0.02, rtol=0)
    torch.testing.assert_close(started.roughness, torch.tensor([[0.4]]), atol=0.02, rtol=0)
    torch.testing.assert_close(started.metallic, torch.tensor([[0.05]]), atol=0.02, rtol=0)
