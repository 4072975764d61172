"""Lamps of an initial light move to their places together with its map, on a ball of which all is known."""

from __future__ import annotations

import dataclasses

import pytest
import torch

from neilfpp_method.effects.evidence.lamps import LampTrial
from neilfpp_method.effects.first_lamps import settle_first_lamps
from neilfpp_method.effects.first_light import FirstLight
from neilfpp_method.effects.places.fit import Permitted, fit_places
from neilfpp_method.shading import LOBES
from neilfpp_method.structures import Material
from tests.effects.balls import ball, data_of
from tests.effects.evidence.test_lamps import lamp, lit_by

LOBE = LOBES["ggx"]
COUNT, VIEWS, ROUGHNESS = 110, 9, 0.36


def test_a_misplaced_lamp_moves_although_the_initial_materials_contain_its_light():
    torch.manual_seed(1)
    colors, ones = 0.2 + 0.6 * torch.rand(8, 3), torch.ones(COUNT, 1)
    normal = ball(ones.expand(COUNT, 3), ones, 0 * ones, None, views=1).observed.normal
    color = colors[((normal > 0) * torch.tensor([1, 2, 4])).sum(-1)]
    places, true = ball(color, ROUGHNESS * ones, 0 * ones, LOBE, VIEWS), lamp((0.0, -0.9, 0.9), 1.0)
    material = Material(*(v[places.place] for v in (color, ROUGHNESS * ones, 0 * ones)))
    data = data_of(dataclasses.replace(places, observed=lit_by(true, places.observed, material)), LOBE)
    scale = color.log().mean().exp().item()
    fit = fit_places(data, Permitted(False, scale), rounds=2)
    first = FirstLight(fit, scale, {}, data, False, LampTrial(data.hold_back(0, 5), pytest.fail))
    found = lamp((0.15, -1.0, 1.1), 0.6)

    settled = settle_first_lamps(first, found, LOBE, None)
    assert len(settled.lamps.intensity) == 1
    miss = (settled.lamps.places.position - true.lit_places.position).norm()
    assert miss < 0.1 < (found.lit_places.position - true.lit_places.position).norm()
    # Images determine the product of light and base colour.
    shown = settled.lamps.intensity.mean() * settled.light.scale / scale
    assert shown == pytest.approx(1.0, rel=0.4)
    assert found.lit_intensity.mean() == pytest.approx(0.6), "the lamps that were found are not changed"
