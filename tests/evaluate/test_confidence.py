"""The expected errors of a run: which views are used, which points they see, and independence from the batch
size.
"""

from __future__ import annotations

from dataclasses import fields, replace
from pathlib import Path

import numpy as np
import pytest
import torch

from neilfpp_method.data.capture import Capture, load_capture
from neilfpp_method.errors import UserError
from neilfpp_method.evaluate import confidence
from neilfpp_method.evaluate.confidence import (
    MIN_NOISE,
    material_deviation,
    measure_residuals,
    surface_at_pixels,
    with_deviation,
)
from neilfpp_method.evaluate.map_metrics import confidence_metrics
from neilfpp_method.evaluate.metrics import confidence_ratio
from neilfpp_method.evaluate.patches import by_patch, light_by_patch, patch_count
from neilfpp_method.evaluate.render_views import render_run
from neilfpp_method.evaluate.sightings import TrainingViews
from neilfpp_method.evaluate.views import known_test_views, render_test_views
from neilfpp_method.model import NeilfModel
from neilfpp_method.settings.facts import SceneFacts
from neilfpp_method.shading.color import linear_to_srgb
from neilfpp_method.structures import RayBatch, SurfaceHits
from neilfpp_method.train.run import Run
from tests.data.make_capture import RADIUS, SCALE, make_capture
from tests.scenes import meet_ball, tiny_config

SPHERE = RADIUS / SCALE  # radius in the scene frame


class Ball:
    """The sphere of `make_capture` as a white host with a sharp surface."""

    def render(self, rays: RayBatch) -> SurfaceHits:
        position, hit = meet_ball(rays, SPHERE)
        position = torch.where(hit[:, None] > 0, position, rays.origins)
        return SurfaceHits(hit[:, None].expand(-1, 3), position, hit[:, None] * position / SPHERE, hit, hit)


def make_run(capture: Capture, mode: str = "soft") -> Run:
    """An untrained run."""
    torch.manual_seed(0)
    config = tiny_config()
    config = replace(config, light=replace(config.light, inter_reflection=mode))
    model = NeilfModel(Ball(), config, SceneFacts("linear", 0.3, 3.0, "none")).eval()
    return Run(Path("run"), config, capture, model.facts, model, 12)


@pytest.fixture(scope="module")
def run(tmp_path_factory) -> Run:
    return make_run(
        load_capture(
            make_capture(tmp_path_factory.mktemp("captures") / "ball", size=(96, 72), views=6, test=(0,))
        )
    )


@pytest.fixture(scope="module")
def residuals(run: Run):
    return measure_residuals(run)


def on_sphere(count: int) -> torch.Tensor:
    torch.manual_seed(0)
    return torch.nn.functional.normalize(torch.randn(count, 3), dim=-1)


# ------------------------------------------------------------------------------------------------------ views


@pytest.mark.parametrize("mode", ["soft", "hard"])
def test_a_view_sees_the_part_of_a_sphere_that_faces_it(run: Run, mode: str):
    run = make_run(run.capture, mode)
    views = TrainingViews(run.capture)
    normal = on_sphere(200)
    seen = views.sightings(run.model, SPHERE * normal, normal, len(views.cameras))
    for i, n in enumerate(normal):
        towards = views.centers - SPHERE * n
        cosine = (towards / towards.norm(dim=-1, keepdim=True)) @ n
        # Pixels at the rim are half off the object, and grazing views are not used.
        assert (cosine > 0.2).sum() <= seen.visible[i].sum() <= (cosine > 0.05).sum()
    cosine = (seen.wo * normal[:, None]).sum(-1)
    assert (cosine[seen.visible] > 0).all()
    assert torch.equal(seen.wo[~seen.visible], normal[:, None].expand_as(seen.wo)[~seen.visible])
    assert not seen.pixel[~seen.visible].any()
    assert (seen.pixel[seen.visible] > 0).any(-1).all()


def test_clipped_pixels_are_not_used(run: Run, monkeypatch):
    """Also those of a reduced image, whose pixels are averaged and encoded again, with rounding below 1."""
    views, normal = TrainingViews(run.capture), on_sphere(50)
    white, view = linear_to_srgb(torch.tensor(1.0)), views.pixels.view
    monkeypatch.setattr(views, "hdr", False)
    monkeypatch.setattr(
        views.pixels,
        "view",
        lambda *given, **named: replace(view(*given, **named), color=white.expand(72 * 96, 3)),
    )
    assert not views.sightings(run.model, SPHERE * normal, normal, len(views.cameras)).visible.any()


def test_the_first_views_are_far_from_one_another(run: Run):
    views = TrainingViews(run.capture)
    assert sorted(views.order) == list(range(len(views.cameras)))
    gap = (views.centers[views.order[0]] - views.centers[views.order[1]]).norm()
    assert gap == (views.centers - views.centers[views.order[0]]).norm(dim=-1).max()


# ------------------------------------------------------------------------------------------------------ light


def test_patches_add_up_to_all_light(run: Run):
    normal = on_sphere(20)
    material = run.model.materials(SPHERE * normal)
    arriving = light_by_patch(run.model, SPHERE * normal, normal, normal[:, None], material)
    parts = by_patch(arriving.light, arriving.patch, patch_count(run.model))
    torch.testing.assert_close(parts.sum(-1), arriving.light.sum(1))
    assert ((parts > 0).any(1).sum(-1) > 5).all()


# -------------------------------------------------------------------------------------------------- deviation


def test_the_result_does_not_depend_on_the_batches(run: Run, residuals, monkeypatch):
    normal = on_sphere(40)
    whole = material_deviation(run.model, residuals, SPHERE * normal, normal)
    monkeypatch.setattr(confidence, "POINTS_AT_ONCE", 7)
    monkeypatch.setattr(confidence, "SIGHTED_AT_ONCE", 16)
    shares: list[float] = []
    parts = material_deviation(run.model, residuals, SPHERE * normal, normal, shares.append)
    for f in fields(whole):
        torch.testing.assert_close(getattr(parts, f.name), getattr(whole, f.name), rtol=1e-3, atol=1e-4)
    assert shares == sorted(shares)
    assert shares[-1] == 1.0


def test_a_point_without_views_has_the_error_of_a_guess(run: Run, residuals):
    normal = on_sphere(60)
    with torch.no_grad():
        material = run.model.materials(SPHERE * normal)
    prior = (1 / 12 + (material.base_color - 0.5).square().mean(-1, keepdim=True)).sqrt()
    inside_out = material_deviation(run.model, residuals, SPHERE * normal, -normal)
    torch.testing.assert_close(inside_out.base_color, prior, rtol=1e-2, atol=0.0)
    outside = material_deviation(run.model, residuals, SPHERE * normal, normal)
    seen = residuals.views.sightings(run.model, SPHERE * normal, normal, 5).visible.any(1)
    # Points whose pixels are not explained also have the error of a guess.
    assert ((outside.base_color - prior)[seen].abs() > 1e-3).float().mean() > 0.5
    torch.testing.assert_close(outside.base_color[~seen], prior[~seen], rtol=1e-2, atol=0.0)


def test_well_explained_images_lower_the_expected_error(run: Run, residuals):
    normal = on_sphere(60)
    hopeless = replace(residuals, noise=1e4, misfit=MIN_NOISE)
    doubt = [
        material_deviation(run.model, believed, SPHERE * normal, normal).roughness.var().item()
        for believed in (hopeless, replace(residuals, noise=0.05))
    ]
    assert doubt[0] < 1e-6 < doubt[1]  # untrained: every point has the error of a guess


def test_points_with_unexplained_pixels_have_larger_errors(run: Run, residuals):
    normal = on_sphere(60)
    looks = residuals.views.sightings(run.model, SPHERE * normal, normal, 5).visible.sum(1)
    usual, off = (
        material_deviation(run.model, replace(residuals, misfit=misfit), SPHERE * normal, normal).metallic[
            :, 0
        ]
        for misfit in (100 * residuals.misfit, 10 * residuals.misfit)
    )
    assert torch.equal(usual[looks == 0], off[looks == 0])
    assert (off >= usual).all()
    # Both are small compared with the typical error, so the prior views dominate.
    assert (off > 1.0005 * usual)[looks > 0].float().mean() > 0.5


def test_only_neighbors_are_smoothed(run: Run, residuals):
    apart = on_sphere(9)
    around = torch.nn.functional.normalize(
        apart[:1] + 0.01 * torch.randn(9, 3, generator=torch.Generator().manual_seed(0)), dim=-1
    )
    normal = torch.cat((around, apart[1:]))
    alone = material_deviation(run.model, residuals, SPHERE * apart[1:], apart[1:]).roughness
    found = material_deviation(run.model, residuals, SPHERE * normal, normal).roughness
    assert (found[:9] == found[0]).all()
    torch.testing.assert_close(found[9:], alone, rtol=1e-3, atol=1e-4)
    assert len(found[9:].unique()) > 1


def test_a_run_that_shows_no_surface_has_noise_as_large_as_its_pixels(run: Run):
    class Nothing(Ball):
        def render(self, rays: RayBatch) -> SurfaceHits:
            hits = super().render(rays)
            return replace(hits, opacity=0 * hits.opacity, concentration=0 * hits.concentration)

    run = make_run(run.capture)
    run.model.host = Nothing()
    residuals = measure_residuals(run)
    assert (residuals.noise, residuals.misfit) == (1.0, 1.0)
    assert not residuals.typical.any()


def test_an_empty_batch_of_points(run: Run, residuals):
    assert len(material_deviation(run.model, residuals, torch.zeros(0, 3), torch.zeros(0, 3))) == 0


# ------------------------------------------------------------------------------------------- maps and figures


def test_maps_cover_the_surface_and_a_step_repeats_pixels(run: Run, residuals):
    view = render_test_views(run)[0]
    hit = view.maps["opacity"][..., 0] > 0.5
    coarse = with_deviation(run, residuals, view, step=4)
    for name in ("base_color_std", "roughness_std", "metallic_std"):
        values = coarse.maps[name]
        assert values.shape == (*hit.shape, 1)
        asked = values[::4, ::4, 0]
        assert np.array_equal(asked > 0, hit[::4, ::4])
        assert np.array_equal(values[1::4, 2::4, 0], asked[: len(values[1::4]), : values[:, 2::4].shape[1]])


def test_the_surface_at_pixels_is_where_the_sphere_is(run: Run):
    view = render_test_views(run)[0]
    pixels = np.flatnonzero(view.maps["opacity"][..., 0] > 0.99)
    points = surface_at_pixels(run, view, pixels)
    torch.testing.assert_close(
        points.position.norm(dim=-1), torch.full((len(pixels),), SPHERE), rtol=1e-4, atol=0.0
    )


def test_figures_exist_for_maps_with_known_truth(run: Run):
    rendered = render_test_views(run)
    pairs = list(zip(rendered, known_test_views(run, rendered).views, strict=True))
    figures = confidence_metrics(run, pairs)
    assert figures.keys() == {f"confidence_{name}_ratio" for name in ("base_color", "roughness", "metallic")}
    assert all(value > 0 for value in figures.values())
    assert confidence_metrics(replace(run, step=0), pairs) == {}


def test_the_ratio_compares_the_half_with_smaller_expected_errors():
    error = np.array([4.0, 1.0, 2.0, 3.0, 9.0])
    assert confidence_ratio(error, error) == pytest.approx(((1 + 2) / 2) / ((3 + 4 + 9) / 3))
    assert confidence_ratio(error, -error) == pytest.approx(((9 + 4) / 2) / ((1 + 2 + 3) / 3))
    assert confidence_ratio(np.zeros(4), np.arange(4.0)) is None
    assert confidence_ratio(np.ones(1), np.ones(1)) is None


def test_a_render_with_confidence_completes_one_without(run: Run, tmp_path: Path):
    path = render_run(run, tmp_path, ("test",))[0]
    picture = tmp_path / "metallic_std" / f"{path.stem}.png"
    assert not picture.exists()
    render_run(run, tmp_path, ("test",), confidence=True)
    assert picture.exists()
    with pytest.raises(UserError, match="no material"):
        render_run(replace(run, step=0), tmp_path, ("test",), confidence=True)
