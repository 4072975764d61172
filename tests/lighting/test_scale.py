"""The common scale of light and base colour: what cameras saw of the light, or an initial light, fixes it."""

from __future__ import annotations

import dataclasses

import pytest
import torch

from neilfpp_method.fields.environment import EnvironmentLight
from neilfpp_method.lighting.fit import Evidence
from neilfpp_method.lighting.map_transport import from_texels
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


def looks_fix_the_scale(below: float) -> bool:
    """Whether cameras that saw all directions below a height saw enough of the light."""
    sky = SkySightings(8, "linear")
    wi = looks(4000, below)
    sky.remember(wi, torch.ones_like(wi))
    return sky.known().fixes_scale
