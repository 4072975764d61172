"""The scale between light and base colour: the lowest error, or the reflectance of metals."""

from __future__ import annotations

import math

import pytest
import torch

from neilfpp_method.effects.light_scale import (
    SCALES,
    lowest_scale,
    scale_of_metals,
    unbounded_scale,
    with_prior,
)
from neilfpp_method.effects.places.data import ROWS
from neilfpp_method.effects.places.fit import PlaceFit
from neilfpp_method.effects.places.gathering import Places
from neilfpp_method.effects.places.grid import METALLICS
from neilfpp_method.shading import LOBES
from neilfpp_method.structures import Observed
from tests.effects.balls import ball, data_of

COUNT, VIEWS = 40, 3


def test_lowest_is_the_minimum_of_the_parabola_over_the_logarithm():
    def errors(foot: float) -> dict[float, float]:
        return {s: math.log(s / foot) ** 2 for s in SCALES}

    assert lowest_scale(errors(0.27)) == pytest.approx(0.27)
    assert lowest_scale(errors(0.05)) == 0.1  # at an end: no further
    assert lowest_scale(errors(0.9)) == 0.7


@pytest.mark.parametrize("noise", [-3e-4, 3e-4])
def test_noise_of_one_error_hardly_shifts_a_minimum_of_many(noise: float):
    """The minimum of the parabola through three errors shifts by up to 9 %."""
    errors = {1.19**n: 0.07 + 3e-4 * n**2 for n in range(-3, 4)}
    for scale in errors:
        noisy = errors | {scale: errors[scale] + noise}
        assert lowest_scale(noisy, max_rise=0.05) == pytest.approx(1.0, rel=0.025)


def test_steep_rises_do_not_count():
    errors = {1.19**n: 0.07 + 3e-4 * n**2 for n in range(-3, 4)}
    steep = errors | {1.19**2: 0.1, 1.19**3: 0.17}
    assert lowest_scale(steep, max_rise=0.05) == pytest.approx(1.0, rel=0.01)


def test_photographs_need_a_clear_minimum_for_an_unusual_scale():
    flat = dict(zip(sorted(SCALES), (0.199, 0.206, 0.209, 0.209, 0.210, 0.215), strict=True))
    assert lowest_scale(with_prior(flat, "linear")) == 0.1
    assert lowest_scale(with_prior(flat, "srgb")) == pytest.approx(0.28, abs=0.05)
    clear = {scale: 0.13 + 0.05 * math.log(scale / 0.6) ** 2 for scale in SCALES}
    assert lowest_scale(with_prior(clear, "srgb")) == pytest.approx(0.52, abs=0.04)


def fitted(scale: float, metal_share: float) -> PlaceFit:
    """Places with one base colour, of which some are metal."""
    metallic = torch.zeros(COUNT, dtype=torch.long)
    metallic[: round(metal_share * COUNT)] = len(METALLICS) - 1
    return PlaceFit(
        torch.zeros(3, ROWS, 2 * ROWS), torch.full((COUNT, 3), scale), torch.zeros_like(metallic), metallic
    )


def chosen(excess: dict[float, float], metal_share: float) -> float | None:
    """The scale for given mean errors above the lowest, with noise of 0.01 per place."""
    generator = torch.Generator().manual_seed(0)
    place = torch.arange(COUNT).repeat_interleave(VIEWS)
    blank = torch.zeros(len(place), 3)
    held_back = Places(COUNT, place, place % VIEWS, Observed(blank, blank, blank, blank))
    noise = {s: 0.01 * torch.randn(COUNT, generator=generator) for s in excess}
    errors = {s: 0.2 + value + (noise[s] - noise[s].mean())[place] for s, value in excess.items()}
    return scale_of_metals({s: fitted(s, metal_share) for s in excess}, errors, held_back)


def test_metals_have_the_reflectance_of_real_metals_where_the_images_do_not_tell():
    flat = {0.22: 0.001, 0.33: 0.0, 0.5: 0.001, 0.7: 0.001}
    assert chosen(flat, 0.8) == pytest.approx(0.7)


def test_held_back_views_bound_the_scale_of_metals():
    assert chosen({0.22: 0.001, 0.33: 0.0, 0.5: 0.001, 0.7: 0.05}, 0.8) == 0.5
    assert chosen({0.22: 0.05, 0.33: 0.0, 0.5: 0.05, 0.7: 0.1}, 0.8) == 0.33


def test_few_metals_do_not_determine_the_scale():
    assert chosen({0.22: 0.001, 0.33: 0.0, 0.5: 0.001}, 0.4) is None


@pytest.mark.parametrize(("dark", "expected"), [(0.3, 0.33), (0.01, 0.1)])
def test_few_base_colors_are_at_their_bound(dark: float, expected: float):
    """White and dark paint: with dark paint of 0.01, a mean of 0.33 would need a white of 10."""
    base_color = torch.full((60, 3), dark)
    base_color[::2] = 0.9
    lobe = LOBES["ggx"]
    places = ball(base_color, torch.full((60, 1), 0.5), torch.zeros(60, 1), lobe)
    assert unbounded_scale(data_of(places, lobe)) == expected
