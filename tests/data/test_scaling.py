"""Views at another size: cameras compared with projected points, pixels with exact means over their areas."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch

from neilfpp_method.data.cameras.lens import Lens
from neilfpp_method.data.cameras.projection import CameraRays, project
from neilfpp_method.data.capture import load_capture
from neilfpp_method.data.files.images import read_image, write_exr, write_png
from neilfpp_method.data.pixels.dataset import PixelDataset
from neilfpp_method.data.scaling import (
    PIXELS_OF_A_RAY,
    PIXELS_OF_A_VIEW,
    area_average,
    at_scale,
    scale_for_pixels,
    scale_for_rays,
    scale_for_width,
    scaled_view,
)
from neilfpp_method.data.truth import Truth
from neilfpp_method.errors import UserError
from tests.data.make_capture import make_capture, radiance, srgb


@pytest.mark.parametrize("lens", [None, Lens("OPENCV", (-0.1, 0.02, 1e-3, -1e-3))])
@pytest.mark.parametrize("scale", [0.5, 0.37])
def test_points_project_to_the_scaled_position(tmp_path: Path, scale: float, lens: Lens | None) -> None:
    view = load_capture(make_capture(tmp_path)).views[1]
    view = replace(view, camera=replace(view.camera, lens=lens))
    small = scaled_view(view, scale)
    size = np.array([small.camera.width, small.camera.height])
    assert np.array_equal(size, np.rint(np.array([24, 18]) * scale))
    points = torch.from_numpy(np.random.default_rng(0).normal([0.3, -0.2, 0.5], 0.4, (50, 3)))
    before, after = project(view.camera, points), project(small.camera, points)
    expected = before.pixel.numpy() * size / [24, 18]
    assert np.allclose(after.pixel.numpy(), expected, atol=1e-9)
    assert torch.equal(before.depth, after.depth)


def test_the_ray_of_a_pixel_leads_through_the_middle_of_its_area(tmp_path: Path) -> None:
    view = load_capture(make_capture(tmp_path)).views[1]
    small = scaled_view(view, 1 / 3)
    rays = CameraRays([view.camera, small.camera], dtype=torch.float64)
    middle = torch.tensor(
        [4 * 24 + 7]
    )  # of the 3×3 pixels about row 4, column 7, which are one of the small image
    one = rays(torch.tensor([0]), middle)
    other = rays(torch.tensor([1]), torch.tensor([1 * 8 + 2]))
    assert torch.allclose(one.directions, other.directions, atol=1e-12)


def test_scaling_there_and_back(tmp_path: Path) -> None:
    capture = load_capture(make_capture(tmp_path))
    back = at_scale(at_scale(capture, 0.4), 1.0)
    for view, again in zip(capture.views, back.views, strict=True):
        assert again.file_size is None
        assert np.allclose(view.camera.intrinsics, again.camera.intrinsics)


@pytest.mark.parametrize("scale", [0.0, -1.0, 1.5, float("nan")])
def test_invalid_scales_are_refused(tmp_path: Path, scale: float) -> None:
    with pytest.raises(UserError, match="images cannot be scaled by"):
        at_scale(load_capture(make_capture(tmp_path)), scale)


# --------------------------------------------------------------------------------------------------- averages


def test_means_over_parts_of_pixels() -> None:
    values = np.random.default_rng(0).random((6, 10, 3), dtype=np.float32)
    fine = values.repeat(4, 0).repeat(7, 1)  # 24 × 70: both sizes divide it
    exact = fine.reshape(4, 6, 7, 10, 3).mean(axis=(1, 3))
    assert np.allclose(area_average(values, 7, 4), exact, atol=1e-6)


def test_display_values_are_averaged_in_linear_light(tmp_path: Path) -> None:
    capture = load_capture(make_capture(tmp_path, hdr=False))
    board = (np.indices((18, 24)).sum(0) % 2 * 255).astype(np.uint8)
    write_png(capture.views[0].image, np.repeat(board[..., None], 3, axis=2))
    color = PixelDataset(at_scale(capture, 0.5), at_scale(capture, 0.5).views[:1]).view(0).color
    assert torch.allclose(color, torch.full_like(color, float(srgb(np.float64(0.5)))), atol=1e-4)


@pytest.mark.parametrize("hdr", [True, False])
def test_small_views_agree_with_large_ones(tmp_path: Path, hdr: bool) -> None:
    """Rays and pixels of a reduced capture compared with the analytic sphere."""
    capture = at_scale(load_capture(make_capture(tmp_path, size=(240, 180), hdr=hdr, masks=True)), 0.25)
    batch = PixelDataset(capture, capture.views).view(2)
    o, d = batch.origins.double().numpy(), batch.directions.double().numpy()
    b = (o * d).sum(-1)
    inside = b**2 - (o**2).sum(-1) + 0.8**2
    well_inside = inside > 0.15  # the mean over a pixel is its centre's but for the curvature
    normal = (o + (-b - np.sqrt(inside.clip(0)))[:, None] * d) / 0.8
    expected = radiance(normal) if hdr else srgb(radiance(normal))
    assert well_inside.sum() > 300
    assert np.abs(batch.color.numpy() - expected)[well_inside].mean() < 4e-3
    assert batch.mask.numpy()[well_inside].all()
    assert not batch.mask.numpy()[inside < -0.15].any()


def test_a_reduced_pixel_is_valid_if_all_its_sources_are(tmp_path: Path) -> None:
    capture = load_capture(make_capture(tmp_path))
    valid = np.full((18, 24), 255, np.uint8)
    valid[5, 9] = 0
    write_png(tmp_path / "valid.png", valid)
    color = read_image(capture.views[0].image).pixels.copy()
    color[5, 9] = np.nan
    write_exr(capture.views[0].image, {"RGB": color})
    view = scaled_view(replace(capture.views[0], valid=tmp_path / "valid.png"), 0.5)
    pixels = PixelDataset(capture, [view])
    expected = torch.ones(9, 12, dtype=torch.bool)
    expected[2, 4] = False
    assert torch.equal(pixels.valid(0).reshape(9, 12), expected)
    assert pixels.view(0).color.isfinite().all()


def test_truth_at_a_smaller_size(tmp_path: Path) -> None:
    capture = load_capture(make_capture(tmp_path, size=(48, 36)))
    small = at_scale(capture, 0.5)
    whole, truth, view = Truth(capture), Truth(small), small.test_views[0]
    depth = whole.depth(capture.test_views[0]).reshape(18, 2, 24, 2)
    covered = (depth > 0).all(dim=3).all(dim=1)
    assert torch.equal(truth.depth(view).reshape(18, 24) > 0, covered)
    assert torch.equal(truth.depth(view).reshape(18, 24)[covered], depth[:, 1, :, 1][covered])
    color = whole.material(capture.test_views[0]).base_color.reshape(18, 2, 24, 2, 3).mean(dim=(1, 3))
    assert torch.allclose(truth.material(view).base_color.reshape(18, 24, 3), color, atol=1e-6)


# ------------------------------------------------------------------------------------------------ which scale


def photographs(tmp_path: Path, count: int, width: int, height: int) -> list:
    view = load_capture(make_capture(tmp_path)).views[0]
    return [replace(view, camera=replace(view.camera, width=width, height=height))] * count


def test_the_scale_that_rays_can_use(tmp_path: Path) -> None:
    views = photographs(tmp_path, 20, 4000, 3000)
    rays = 1_800_000
    scale = scale_for_rays(views, rays)
    pixels = sum(v.camera.width * v.camera.height for v in (scaled_view(view, scale) for view in views))
    assert pixels == pytest.approx(PIXELS_OF_A_RAY * rays, rel=0.01)
    assert scale_for_rays(views, 10**9) == 1.0
    few = scaled_view(views[0], scale_for_rays(views, 1000))
    assert few.camera.width * few.camera.height == pytest.approx(PIXELS_OF_A_VIEW, rel=0.01)


def test_a_scale_close_to_one_is_one(tmp_path: Path) -> None:
    views = photographs(tmp_path, 1, 400, 300)
    assert scale_for_pixels(views, 119_000) == 1.0
    assert scale_for_pixels(views, 60_000) == pytest.approx(0.5**0.5, abs=1e-3)
    assert scale_for_width(views, 100) == 0.25
    assert scale_for_width(views, 4000) == 1.0
    with pytest.raises(UserError, match="0 pixels wide"):
        scale_for_width(views, 0)
