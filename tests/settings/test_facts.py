"""The units of the losses."""

from __future__ import annotations

import pytest
import torch

from neilfpp_method import losses
from neilfpp_method.settings.facts import SceneFacts, radiance_units
from neilfpp_method.settings.presets import preset
from neilfpp_method.shading.color import apply_response


@pytest.mark.parametrize("median", [1e-3, 0.05, 0.47])
def test_an_error_of_radiance_counts_the_same_in_every_response(median):
    truth = torch.full((1, 3), median)
    found = []
    for response in ("linear", "srgb"):
        units = radiance_units(preset("fast"), SceneFacts(response, median, 20 * median, "none"))
        pixel = apply_response(truth, response)
        found.append(losses.photometric(1.02 * truth, pixel, response, units.volume).mean().item())
        assert units.incident == median
        assert units.physical == units.volume
    assert found == pytest.approx([0.02, 0.02], rel=0.02)


def test_the_papers_units():
    units = radiance_units(preset("paper-mlp"), SceneFacts("linear", 0.2, 4.0, "none"))
    assert (units.volume, units.physical, units.incident) == (4.0, 1.0, 1.0)
