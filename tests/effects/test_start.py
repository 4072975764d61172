"""The start of a model: the map, the mean material, and the pixels at which lamps are sought."""

from __future__ import annotations

import pytest
import torch

from neilfpp_method.effects.places.data import ROWS
from neilfpp_method.effects.start import start_with
from neilfpp_method.lighting.solver import NothingToSolve
from neilfpp_method.settings.presets import preset
from neilfpp_method.shading.color import linear_to_srgb
from neilfpp_method.structures import Material, Observed
from tests.effects.balls import first_light_of_sky, sky
from tests.scenes import sphere_model


def test_a_model_starts_with_the_estimated_map():
    model = sphere_model(preset("fast"))
    start_with(model, NothingToSolve(), first_light_of_sky())
    coarse = model.light.at_most(ROWS).log_radiance
    assert (coarse - sky().log_radiance).abs().median() < 0.1


class Listener(NothingToSolve):
    """A solver that keeps what it is asked to look at for lamps."""

    def start(self, observed: Observed, material: Material, *_: object) -> None:
        self.observed, self.material = observed, material


@pytest.mark.parametrize("response", ["linear", "srgb"])
def test_lamps_are_sought_in_pixels_as_the_capture_has_them_on_surfaces_of_one_colour(response):
    first, listener = first_light_of_sky(response), Listener()
    start_with(sphere_model(preset("fast")), listener, first)
    linear = first.data.places.observed.pixel.sort(0).values
    expected = linear_to_srgb(linear) if response == "srgb" else linear
    torch.testing.assert_close(listener.observed.pixel.sort(0).values, expected)
    assert (listener.material.base_color == first.mean.base_color).all()
