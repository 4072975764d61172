"""Figures of relit images compared with true images."""

from __future__ import annotations

import numpy as np
import pytest

from neilfpp_method.data.capture import load_capture
from neilfpp_method.data.files.images import write_exr, write_png
from neilfpp_method.errors import UserError
from neilfpp_method.relight.comparison import TrueImage, compare, find_truth, read_truth
from tests.data.make_capture import make_capture, srgb


def images(count: int = 2):
    generator = np.random.default_rng(0)
    return [generator.uniform(0.1, 0.6, (16, 20, 3)).astype(np.float32) for _ in range(count)]


def true(image: np.ndarray, mask: np.ndarray | None, name: str = "a") -> TrueImage:
    return TrueImage(name, image, mask, "true depth" if mask is not None else "rendered opacity", 0.5 * image)


def test_one_scale_for_all_views_and_none():
    first, second = images()
    mask = np.zeros((16, 20), bool)
    mask[2:14, 3:15] = True
    scale = np.array([0.5, 0.8, 1.25])
    relit = [np.where(mask[..., None], image / scale, 7.0) for image in (first, second)]
    found = compare(relit, [np.ones((16, 20))] * 2, [true(first, mask, "a"), true(second, mask, "b")])
    assert found.scale == pytest.approx(scale, rel=1e-5)
    assert found.figures["relight_psnr_scaled"] > 95
    assert set(found.views) == {"a", "b"}
    error = np.concatenate([(srgb(r) - srgb(i))[mask] for r, i in zip(relit, (first, second), strict=True)])
    each = [-10 * np.log10((part**2).mean()) for part in np.split(error, 2)]
    assert found.figures["relight_psnr"] == pytest.approx(np.mean(each), abs=1e-3)
    frame = [-10 * np.log10((part**2).sum() / (16 * 20 * 3)) for part in np.split(error, 2)]
    assert found.figures["relight_psnr_frame"] == pytest.approx(np.mean(frame), abs=1e-3)
    # The photographs are half as bright, which one scale undoes.
    assert found.figures["baseline_psnr_scaled"] > 95
    assert found.figures["baseline_psnr"] < 25


def test_without_a_mask_the_rendered_pixels_count():
    (image,) = images(1)
    opacity = np.zeros((16, 20))
    opacity[:8] = 1
    found = compare([np.where(opacity[..., None] > 0, image, 9.0)], [opacity], [true(image, None)])
    assert found.figures["relight_psnr"] == 100
    assert found.mask_source == "rendered opacity"
    with pytest.raises(UserError, match="no pixel"):
        compare([image], [0 * opacity], [true(image, None)])


def test_true_images_are_read_with_their_masks(tmp_path):
    capture = load_capture(make_capture(tmp_path / "capture"))
    view = capture.test_views[0]
    linear = np.full((18, 24, 3), 0.25, np.float32)
    write_png(tmp_path / "truth" / "000.png", np.rint(255 * srgb(linear)).astype(np.uint8))
    found = find_truth(tmp_path / "truth", capture.test_views)
    read = read_truth(capture, view, found["000"])
    np.testing.assert_allclose(read.image, 0.25, atol=0.003)
    assert read.mask_source == "true depth"
    assert 0 < read.mask.mean() < 1
    assert read.photograph[read.mask].mean() > 0.1
    alpha = np.zeros((18, 24, 1), np.float32)
    alpha[:9] = 1
    write_exr(tmp_path / "truth" / "000.exr", {"RGBA": np.concatenate([linear, alpha], axis=2)})
    read = read_truth(capture, view, find_truth(tmp_path / "truth", capture.test_views)["000"])
    assert read.mask_source == "alpha of the true images"
    assert read.mask[:9].all()
    assert not read.mask[9:].any()


def test_missing_true_images_and_other_sizes_are_refused(tmp_path):
    capture = load_capture(make_capture(tmp_path / "capture"))
    with pytest.raises(UserError, match="no true image of the view 000"):
        find_truth(tmp_path, capture.test_views)
    write_exr(tmp_path / "000.exr", {"RGB": np.ones((9, 12, 3), np.float32)})
    with pytest.raises(UserError, match="12×9"):
        find_truth(tmp_path, capture.test_views)
    write_exr(tmp_path / "000.exr", {"RGB": np.full((18, 24, 3), np.nan, np.float32)})
    with pytest.raises(UserError, match="not finite"):
        read_truth(capture, capture.test_views[0], tmp_path / "000.exr")
