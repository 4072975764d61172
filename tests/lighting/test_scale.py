"""The common scale of light and base colour: what cameras saw of the light, or an initial light, fixes it."""

from __future__ import annotations

import dataclasses
import math

import pytest
import torch

from neilfpp_method.fields.environment import EnvironmentLight
from neilfpp_method.lighting.fit import CarriedLight, Evidence, MapAndLamps, error_reduction
from neilfpp_method.lighting.map_transport import from_texels
from neilfpp_method.lighting.objective import Objective, Target
from neilfpp_method.lighting.sky import SkySightings
from neilfpp_method.settings.presets import preset
from neilfpp_method.structures import Material, Observed
from tests.lighting.surfaces import looks, material, points
from tests.scenes import sphere_model

MEAN = 0.4
DRIFT = 0.3
"""Factor by which the surfaces became darker after the initial light."""


def never(*_: object) -> Evidence:
    raise AssertionError("no lamps are sought")


def brightness_after_drift(begins: bool, sky_below: float | None = None) -> float:
    """Factor on the radiance of the map by a fit after base colours have become darker by `DRIFT`.

    Args:
        begins: whether there was an initial light.
        sky_below: height below which cameras saw the directions of the map; None if they saw none of them.
    """
    torch.manual_seed(0)
    fast = preset("fast")
    fit = dataclasses.replace(fast.light.fit, points=400, every=1)
    light = dataclasses.replace(fast.light, kind="distant", environment_height=8, fit=fit)
    model = sphere_model(dataclasses.replace(fast, light=light))
    true = EnvironmentLight(8, 1.0)
    model.light.resample(true.log_radiance)
    seen, made_of = points(400), material(400)
    made_of = dataclasses.replace(made_of, metallic=0 * made_of.metallic)
    base_color = made_of.base_color * MEAN / made_of.base_color.log().mean().exp()
    made_of = dataclasses.replace(made_of, base_color=base_color.clamp(0.05, 0.95))
    sent = from_texels(true, seen, made_of.roughness, model.lobe, None)
    pixel = sent.outgoing(made_of, true.log_radiance.exp().flatten(1).t())
    observed = Observed(seen.position, seen.normal, seen.wo, pixel)
    solver = model.light_solver()
    if sky_below is not None:
        solver.sky = SkySightings(8, "linear")
        wi = looks(4000, below=sky_below)
        solver.sky.remember(wi, torch.ones_like(wi))
    if begins:
        assert solver.start(observed, made_of, None, never) is None

    def darker(x: torch.Tensor) -> Material:
        row = torch.cdist(x, seen.position).argmin(1)
        return Material(DRIFT * made_of.base_color[row], made_of.roughness[row], made_of.metallic[row])

    model.brdf.forward = darker
    for _ in range(2):
        solver.memory.remember(observed)
    assert solver.due
    assert solver.solve(model.brdf, None) is None
    return model.light.log_radiance.mean().exp().item()


def test_the_scale_of_an_initial_light_is_kept():
    assert brightness_after_drift(begins=True) == pytest.approx(1.0, rel=0.15)


def test_without_an_initial_light_the_current_base_colour_defines_the_scale():
    assert brightness_after_drift(begins=False) == pytest.approx(1 / DRIFT, rel=0.3)


def test_a_small_visible_part_of_the_light_does_not_fix_the_scale():
    assert not looks_fix_the_scale(below=-0.8)
    assert brightness_after_drift(begins=True, sky_below=-0.8) == pytest.approx(1.0, rel=0.15)


def test_a_large_visible_part_of_the_light_fixes_the_scale():
    """One fit goes more than half of the way, in logarithms, to the radiance that cameras saw."""
    assert looks_fix_the_scale(below=0.3)
    assert 0.9 < brightness_after_drift(begins=False, sky_below=0.3) < DRIFT**-0.5


def test_lights_are_compared_with_base_colours_of_the_fitted_scale():
    """Base colours are 0.7 of the true ones, and the sky fixes the scale of the light: held-back points that
    were rendered with these base colours would have an error of 0.3.
    """
    seen, of = points(400), material(400)
    of = dataclasses.replace(of, metallic=0 * of.metallic)
    sky, wi = SkySightings(8, "linear"), looks(4000, below=0.3)
    sky.remember(wi, torch.ones_like(wi))
    transport = from_texels(EnvironmentLight(8, 1.0), seen, of.roughness, None, None)
    pixel = transport.outgoing(of, torch.ones(8 * 16, 3))
    target = Target(seen.position, dataclasses.replace(of, base_color=0.7 * of.base_color), pixel)
    objective = Objective("linear", pixel.median().item(), steps=300, sky=sky.known(), log_scale=None)
    start = CarriedLight(MapAndLamps(torch.zeros(3, 8, 16), torch.zeros(0, 3)), transport)
    fitted, held_back = torch.arange(400) % 2 == 0, torch.arange(400) % 2 == 1
    found = start[fitted].fit(target[fitted], objective)
    assert 0.1 < found.log_scale < -math.log(0.7), "the fit goes a part of the way"
    whole = dataclasses.replace(start.light, log_scale=-math.log(0.7))
    dark = MapAndLamps(torch.full((3, 8, 16), -20.0), torch.zeros(0, 3))
    lights = [start[held_back].with_light(light) for light in (dark, whole)]
    assert error_reduction(*lights, target[held_back], objective).mean() > 0.8, "about 0.9 − 0"


def looks_fix_the_scale(below: float) -> bool:
    """Whether cameras that saw all directions below a height saw enough of the light."""
    sky = SkySightings(8, "linear")
    wi = looks(4000, below)
    sky.remember(wi, torch.ones_like(wi))
    return sky.known().fixes_scale
