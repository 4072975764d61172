"""The search for paint at which training is stuck, and the training of the BRDF field on what it finds."""

from __future__ import annotations

import dataclasses
import math

import pytest
import torch

from neilfpp_method.effects.places.gathering import Places
from neilfpp_method.effects.places.lit import NEIGHBOR_PIXELS, light_up, neighbor_count
from neilfpp_method.effects.places.search import (
    COMPARISONS,
    Comparison,
    SearchedMaterial,
    comparison_due,
    search_materials,
    teach,
)
from neilfpp_method.fields.brdf import BrdfField
from neilfpp_method.fields.direction_map import interpolate, map_directions
from neilfpp_method.fields.environment import EnvironmentLight
from neilfpp_method.model import NeilfModel
from neilfpp_method.schedule import Stage, StagePosition
from neilfpp_method.settings.presets import preset
from neilfpp_method.shading import LOBES
from neilfpp_method.structures import Material, SceneLight
from tests.effects.balls import ball, sky
from tests.scenes import sphere_model

COUNT, VIEWS = 160, 6
LOBE = LOBES["ggx"]
PAINT = Material(torch.full((1, 3), 0.07), torch.full((1, 1), 0.45), torch.zeros(1, 1))
METAL = Material(torch.full((1, 3), 0.14), torch.full((1, 1), 0.7), torch.full((1, 1), 0.95))


def fine_sky() -> EnvironmentLight:
    """The sky as a map of the size that training uses."""
    environment = EnvironmentLight(48, 1.0)
    environment.resample(sky().log_radiance)
    return environment


@pytest.fixture(scope="module")
def places() -> Places:
    """A ball of black paint."""
    material = (value.expand(COUNT, -1) for value in vars(PAINT).values())
    return ball(*material, LOBE, VIEWS, fine_sky())


def trained_to(material: Material, places: Places) -> NeilfModel:
    """A model under the true sky whose BRDF field has one material."""
    config = preset("fast")
    shading = dataclasses.replace(config.shading, lobe="ggx")
    model = sphere_model(dataclasses.replace(config, shading=shading))
    model.light.resample(sky().log_radiance)
    model.facts = dataclasses.replace(model.facts, median_radiance=places.observed.pixel.median().item())
    model.brdf.start_at(material)
    return model


def search(model: NeilfModel, places: Places) -> SearchedMaterial:
    return search_materials(model.brdf, light_up(model, places))


def test_black_paint_that_was_learned_as_dark_metal_becomes_paint(places: Places):
    model = trained_to(METAL, places)
    searched = search(model, places)
    assert searched.share > 0.8
    teach(model.brdf, searched)
    with torch.no_grad():
        learned = model.brdf(places.observed.position)
    assert learned.metallic.median() < 0.1
    assert learned.roughness.median() == pytest.approx(0.45, abs=0.12)
    assert learned.base_color.median() == pytest.approx(0.07, abs=0.03)


def test_the_right_material_is_kept(places: Places):
    model = trained_to(PAINT, places)
    searched = search(model, places)
    assert searched.share < 0.2
    before = model.brdf(places.observed.position)
    kept = (searched.material.metallic == before.metallic).float().mean()
    assert kept > 0.8


@pytest.mark.parametrize("metals", [True, False])
def test_shiny_paint_that_was_learned_as_matte_paint_becomes_shiny(metals: bool):
    shiny = places_of_roughness(torch.full((COUNT, 1), 0.28))
    model = trained_to(matte(0.3, 0.0), shiny)
    model.brdf.metals = metals
    searched = search(model, shiny)
    assert searched.share > 0.8
    teach(model.brdf, searched)
    with torch.no_grad():
        learned = model.brdf(shiny.observed.position)
    assert learned.roughness.median() == pytest.approx(0.28, abs=0.03)
    assert learned.metallic.median() < 0.1


def places_of_roughness(roughness: torch.Tensor) -> Places:
    """A ball of grey paint."""
    return ball(torch.full((COUNT, 3), 0.3), roughness, torch.zeros(COUNT, 1), LOBE, VIEWS, fine_sky())


def test_paint_of_about_the_right_roughness_is_kept():
    """The field is more exact than the grid."""
    shiny = places_of_roughness(torch.full((COUNT, 1), 0.28))
    assert search(trained_to(matte(0.3, 0.0, 0.33), shiny), shiny).share < 0.1


def test_a_few_places_of_another_roughness_are_left_to_training():
    few = torch.where(torch.arange(COUNT)[:, None] % 10 == 0, 0.28, 0.9)
    mixed = places_of_roughness(few)
    assert search(trained_to(matte(0.3, 0.0), mixed), mixed).share == 0


def test_a_single_roughness_is_kept():
    shiny = places_of_roughness(torch.full((COUNT, 1), 0.28))
    model = trained_to(matte(0.3, 0.0), shiny)
    model.brdf.varying_roughness = False
    assert search(model, shiny).share == 0


def test_paint_does_not_become_metal():
    one = torch.ones(COUNT, 1)
    metal = ball(0.6 * one.expand(-1, 3), 0.3 * one, one, LOBE, VIEWS, fine_sky())
    assert search(trained_to(PAINT, metal), metal).share == 0


def matte(base_color: float, metallic: float, roughness: float = 0.9) -> Material:
    return Material(*(torch.full((1, n), v) for n, v in ((3, base_color), (1, roughness), (1, metallic))))


def test_matte_paint_that_was_learned_as_rough_metal_becomes_paint():
    one = torch.ones(COUNT, 1)
    stone = ball(0.3 * one.expand(-1, 3), 0.9 * one, 0 * one, LOBE, VIEWS, fine_sky())
    searched = search(trained_to(matte(0.4, 0.8), stone), stone)
    assert searched.share > 0.8
    assert searched.material.metallic.median() == 0


def test_rough_metal_is_kept():
    """The field is not exact, so that its error does not decide alone."""
    one = torch.ones(COUNT, 1)
    iron = ball(0.6 * one.expand(-1, 3), 0.75 * one, one, LOBE, VIEWS, fine_sky())
    assert search(trained_to(matte(0.52, 0.9, 0.8), iron), iron).share < 0.2


def due_after(model: NeilfModel, length: int) -> dict[int, Comparison]:
    """What is compared after which numbers of steps of material init."""
    positions = [StagePosition(Stage.MATERIAL_INIT, n, length) for n in range(1, length + 1)]
    due = {position.step: comparison_due(model, position) for position in positions}
    return {step: comparison for step, comparison in due.items() if comparison is not None}


def test_a_comparison_is_due_once_at_each_of_its_times():
    model = sphere_model(preset("fast"))
    for length in (3, 7, 10, 1500):
        expected = {math.ceil(share * length): comparison for share, comparison in COMPARISONS.items()}
        assert due_after(model, length) == expected
    assert not any(comparison_due(model, StagePosition(Stage.JOINT, n, 30)) for n in range(31))


def test_the_last_comparison_is_of_the_scale_only():
    due = due_after(sphere_model(preset("fast")), 1500)
    assert due == {500: Comparison.MATERIAL, 1000: Comparison.MATERIAL, 1350: Comparison.SCALE}


def test_nothing_is_compared_under_a_free_light_or_without_highlights():
    matte = sphere_model(preset("fast"))
    matte.lobe = None
    for model in (matte, sphere_model(preset("paper-ngp"))):
        assert due_after(model, 30) == {}


def test_gradients_that_the_field_has_are_kept():
    model = sphere_model(preset("fast"))
    position = torch.rand(50, 3)
    model.brdf(position).base_color.sum().backward()
    before = [parameter.grad.clone() for parameter in model.brdf.parameters()]
    teach(model.brdf, SearchedMaterial(position, PAINT[torch.zeros(50, dtype=torch.long)], 1.0))
    after = [parameter.grad for parameter in model.brdf.parameters()]
    assert all(torch.equal(one, other) for one, other in zip(before, after, strict=True))


def test_a_field_learns_the_material_where_it_differs_and_keeps_it_elsewhere():
    config = preset("fast")
    torch.manual_seed(0)
    field = BrdfField(config.brdf, config.encoding, 1.0)
    position = 2 * torch.rand(3000, 3) - 1
    left = (position[:, :1] < 0).float()
    own = field(position)
    material = Material(
        (own.base_color * (1 - left) + 0.8 * left).detach(),
        (own.roughness * (1 - left) + 0.2 * left).detach(),
        (own.metallic * (1 - left) + 0.9 * left).detach(),
    )
    teach(field, SearchedMaterial(position, material, 0.5))
    learned = field(position)
    for name in ("base_color", "roughness", "metallic"):
        off = (getattr(learned, name) - getattr(material, name)).abs()
        assert off.median() < 0.03, name


def mean_parts(model: NeilfModel, places: Places) -> torch.Tensor:
    """The mean of each layer over all pixels and 8 draws of random directions."""
    return torch.stack([light_up(model, places).parts.mean(1) for _ in range(8)]).mean(0)


def test_a_given_map_of_any_size_costs_as_many_rays_as_a_small_one(places: Places, monkeypatch):
    """With a map of 512 × 1024 texels, the rays of all places took 20 GB."""
    rays = []

    def nothing(x: torch.Tensor, wi: torch.Tensor) -> SceneLight:
        rays.append(wi[..., 0].numel())
        return SceneLight(
            torch.zeros_like(wi[..., 0], dtype=torch.bool),
            torch.zeros_like(wi),
            torch.full_like(wi[..., 0], math.inf),
        )

    monkeypatch.setattr(NeilfModel, "scene", property(lambda model: nothing))
    few = places.where(torch.nonzero(places.place < 8)[:, 0])
    model = trained_to(PAINT, places)
    expected = mean_parts(model, few)
    model.light.show(interpolate(sky().log_radiance, map_directions(512, 1024)).permute(2, 0, 1).exp())
    rays.clear()
    light_up(model, few)
    assert sum(rays) <= 2 * 8 * 64 * 128
    torch.testing.assert_close(mean_parts(model, few), expected, rtol=0.05, atol=1e-3)


@pytest.mark.parametrize("pixels_of_a_place", [9, 18])
def test_the_material_of_a_place_is_decided_by_as_many_pixels_of_few_or_many_views(pixels_of_a_place: int):
    count = neighbor_count(2000, 2000 * pixels_of_a_place)
    assert count * pixels_of_a_place == pytest.approx(NEIGHBOR_PIXELS, rel=0.05)


def test_a_place_of_a_small_capture_is_decided_alone():
    """Its neighbours are a large part of the object, so that they are often of another material."""
    assert neighbor_count(120, 120 * 8) == 1
