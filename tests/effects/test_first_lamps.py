"""Lamps of an initial light move to their places together with its map, on a ball of which all is known."""

from __future__ import annotations

import dataclasses

import pytest
import torch

from neilfpp_method.effects.evidence.lamps import LampTrial
from neilfpp_method.effects.first_lamps import FirstLamps, settle_first_lamps
from neilfpp_method.effects.first_light import FirstLight
from neilfpp_method.effects.places.data import PlaceData
from neilfpp_method.effects.places.fit import Permitted, fit_places
from neilfpp_method.fields.lamps import LampPlaces, Lamps
from neilfpp_method.shading import LOBES
from neilfpp_method.structures import Material
from tests.effects.balls import ball, data_of
from tests.effects.evidence.test_lamps import lamp, lit_by

LOBE = LOBES["ggx"]
COUNT, VIEWS, ROUGHNESS = 110, 9, 0.36
TRUE = lamp((0.0, -0.9, 0.9), 1.0)


@pytest.fixture(scope="module")
def lit() -> PlaceData:
    """A painted ball under the true lamp and an even light."""
    torch.manual_seed(1)
    colors, ones = 0.2 + 0.6 * torch.rand(8, 3), torch.ones(COUNT, 1)
    normal = ball(ones.expand(COUNT, 3), ones, 0 * ones, None, views=1).observed.normal
    color = colors[((normal > 0) * torch.tensor([1, 2, 4])).sum(-1)]
    places = ball(color, ROUGHNESS * ones, 0 * ones, LOBE, VIEWS)
    material = Material(*(v[places.place] for v in (color, ROUGHNESS * ones, 0 * ones)))
    return data_of(dataclasses.replace(places, observed=lit_by(TRUE, places.observed, material)), LOBE)


TRUE_SCALE = 0.483
"""Geometric mean of its base colours."""


def settled_from(found: Lamps, data: PlaceData, scale: float) -> FirstLamps:
    """The lamps that settle beside a light without lamps, which was fitted at this scale."""
    torch.manual_seed(1)
    fit = fit_places(data, Permitted(False, scale), rounds=2)
    first = FirstLight(fit, scale, {}, data, False, LampTrial(data.hold_back(0, 5), pytest.fail))
    return settle_first_lamps(first, found, LOBE, None)


def miss(places: LampPlaces) -> float:
    assert len(places.position) == 1
    return (places.position - TRUE.lit_places.position).norm().item()


def test_a_misplaced_lamp_moves_although_the_initial_materials_contain_its_light(lit):
    found = lamp((0.15, -1.0, 1.1), 0.6)
    settled = settled_from(found, lit, TRUE_SCALE)
    assert miss(settled.lamps.places) < 0.1 < miss(found.lit_places)
    # Images determine the product of light and base colour.
    shown = settled.lamps.intensity.mean() * settled.light.scale / TRUE_SCALE
    assert shown == pytest.approx(1.0, rel=0.4)
    assert found.lit_intensity.mean() == pytest.approx(0.6), "the lamps that were found are not changed"


def test_lamps_that_held_back_views_contradict_are_discarded(lit):
    """From much too dark surfaces the lamp moves away from the ball, by more than its size."""
    found = lamp((0.05, -0.95, 0.9), 2.7)
    settled = settled_from(found, lit, 0.3 * TRUE_SCALE)
    assert miss(settled.lamps.places) < 0.1
