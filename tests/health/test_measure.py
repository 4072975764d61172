"""Measurements of real models: fog, a width of the surface, materials at their bounds, held-back pixels."""

from __future__ import annotations

import math

import pytest
import torch

from neilfpp_method.health.measure import measure_surface
from neilfpp_method.health.watch import Watch
from neilfpp_method.model import NeilfModel
from neilfpp_method.schedule import STAGES, Stage, StagePosition
from neilfpp_method.settings.plain import changed
from neilfpp_method.shading.color import tone_map
from neilfpp_method.structures import PixelBatch
from neilfpp_method.train.quality import Quality
from tests.scenes import sphere_batch, sphere_model, tiny_config

PIXELS = sphere_batch(256, spread=0.1)
"""All of them meet the sphere."""


def with_width(width: float) -> NeilfModel:
    """A model whose surface is a sphere of this width β."""
    return sphere_model(changed(tiny_config(), {"host.volume.beta_init": width}))


def found(model: NeilfModel) -> dict[str, str]:
    """The findings at the end of a stage with material, and what they say."""
    watch = Watch(PIXELS, print, print)
    watch.after_stage(model, STAGES[Stage.JOINT], 0, 40)
    return {name: finding.what for name, finding in watch.findings.items()}


# ---------------------------------------------------------------------------------------------------- surface


@pytest.mark.parametrize(("width", "case"), [(0.1, "beta_stuck"), (0.03, "beta_stuck"), (0.02, None)])
def test_a_width_with_which_no_ray_meets_the_surface_at_one_point(width, case):
    """The share of sharp rays that meet the sphere head-on is 0 at β = 0.03 and 1 at 0.02."""
    model = with_width(width)
    assert measure_surface(model, PIXELS, False).sharp == (0.0 if case else 1.0)
    assert found(model).keys() == ({case} if case else set())
    if case:
        assert f"β is still {width:.2g} " in found(model)[case]


def test_a_flat_distance_field_is_fog_with_any_width():
    """A distance that grows 20 times too slowly makes the surface 20 times as soft: the cause is not β."""
    model = with_width(0.01)
    measured = measure_surface(model, PIXELS, False)
    field = model.host.sdf_field
    compute = field.with_gradient

    def flat(x):
        sample = compute(x)
        return type(sample)(sample.distance / 20, sample.gradient / 20, sample.feature)

    field.with_gradient = flat
    assert measured.sharp == 1.0
    assert measure_surface(model, PIXELS, False).sharp == 0.0
    assert found(model).keys() == {"fog"}


# --------------------------------------------------------------------------------------------------- material


def painted(channels: slice, value: float, **changes: object) -> NeilfModel:
    """A model with this value of these parameters everywhere; `changes` are settings of B."""
    model = sphere_model(changed(tiny_config(), {f"brdf.{name}": to for name, to in changes.items()}))
    with torch.no_grad():
        model.brdf.mlp.layers[-1].bias[channels] = math.atanh(2 * value - 1)
    return model


COLOR, ROUGHNESS, METALLIC = slice(0, 3), slice(3, 4), slice(4, 5)


@pytest.mark.parametrize(
    ("channels", "value", "case"),
    [
        (COLOR, 0.0001, "material_at_bounds"),
        (COLOR, 0.9999, "material_at_bounds"),
        (COLOR, 0.9, None),
        (slice(0, 2), 0.9999, None),
        (ROUGHNESS, 0.0001, "roughness_at_bound"),
        (ROUGHNESS, 0.9999, "roughness_at_bound"),
        (ROUGHNESS, 0.1, None),
        (METALLIC, 0.9999, "metallic_at_bound"),
        (METALLIC, 0.0001, None),
    ],
)
def test_a_field_that_has_one_value_everywhere(channels, value, case):
    model = painted(channels, value)
    assert found(model).keys() == ({case} if case else set())


def test_a_measurement_counts_the_points_at_a_bound():
    """White where x > 0, by a rule of the test: the share is that of the rays with x > 0."""
    model = painted(COLOR, 0.5)
    plain = model.brdf.forward

    def half_white(x):
        material = plain(x)
        white = torch.where(x[:, :1] > 0, 1.0, material.base_color)
        return type(material)(white, material.roughness, material.metallic)

    assert measure_surface(model, PIXELS, True).at_bound == 0.0
    model.brdf.forward = half_white
    share = (PIXELS.directions[:, 0] > 0).float().mean().item()
    assert 0.3 < share < 0.7
    assert measure_surface(model, PIXELS, True).at_bound == pytest.approx(share, abs=1e-6)
    assert measure_surface(painted(COLOR, 0.9999), PIXELS, True).at_bound == 1.0


def test_a_decision_of_the_settings_is_not_a_finding():
    """Without metals metallic is 0, whatever the network says; a Lambertian surface has no roughness."""
    assert found(painted(METALLIC, 0.9999, metals=False)) == {}
    lambertian = changed(tiny_config(), {"shading.specular": False})
    model = painted(ROUGHNESS, 0.0001)
    assert found(model).keys() == {"roughness_at_bound"}
    model.use(lambertian)
    assert found(model) == {}


# -------------------------------------------------------------------------------------------------- rendering


def held_back(model: NeilfModel, count: int, gray: bool = False) -> PixelBatch:
    """Pixels with the colours that a model renders there by its material and light, or their mean."""
    pixels = sphere_batch(count, spread=0.5)
    with torch.no_grad(), model.evaluating():
        color = model.maps(pixels.rays).rgb
    pixels.color.copy_(color.mean(0).expand_as(color) if gray else color)
    return pixels


def findings_at(pixels: PixelBatch, model: NeilfModel) -> Watch:
    """What is found at held-back pixels at the end of the joint stage."""
    position, watch = StagePosition(Stage.JOINT, 4, 4), Watch(None, print, print)
    measured = Quality(pixels).check_when_due(model, position, 12, 1.0)
    watch.after_check(model, position, measured, 12)
    return watch


def test_a_rendering_that_is_worse_than_one_color_is_a_finding():
    """The same scene, and one whose paint is black, at the pixels of the first."""
    right, wrong = painted(COLOR, 0.7), painted(COLOR, 0.0001)
    pixels = held_back(right, 128)
    shown = tone_map(pixels.color)
    best = -10 * math.log10((shown - shown.mean(0)).square().mean().item())
    measured = Quality(pixels).check_when_due(wrong, StagePosition(Stage.JOINT, 4, 4), 12, 1.0)
    assert measured.constant == pytest.approx(best, abs=1e-4)
    assert findings_at(pixels, right).health.verdict == "sound"
    watch = findings_at(pixels, wrong)
    assert list(watch.findings) == ["worse_than_constant"]
    assert (
        f"worse than one colour for all of them ({best:.1f} dB)" in watch.findings["worse_than_constant"].what
    )
    assert watch.health.verdict == "failed"


def test_few_pixels_and_an_object_of_one_color_are_not_compared_with_one_color():
    right = painted(COLOR, 0.7)
    assert findings_at(held_back(right, 64), painted(COLOR, 0.0001)).findings == {}
    gray = held_back(right, 128, gray=True)
    measured = Quality(gray).check_when_due(right, StagePosition(Stage.JOINT, 4, 4), 12, 1.0)
    assert measured.constant > 60.0
    assert 20.0 < measured.physical < 60.0
    assert findings_at(gray, right).findings == {}
