"""Figures of single views, on images in which they are known."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest

from neilfpp_method.data.capture import load_capture
from neilfpp_method.data.files.images import write_exr, write_png
from neilfpp_method.data.views import View
from neilfpp_method.inspection.measure import ViewFigures, measure
from tests.data.make_capture import make_capture

HEIGHT, WIDTH = 60, 80
NOISE = cv2.GaussianBlur(np.random.default_rng(0).uniform(0.05, 1, (HEIGHT, WIDTH, 3)), (0, 0), 1.0).astype(
    np.float32
)


@pytest.fixture
def view(tmp_path: Path) -> View:
    capture = load_capture(make_capture(tmp_path / "capture", size=(WIDTH, HEIGHT)))
    return replace(capture.views[0], image=tmp_path / "image.exr")


def figures(view: View, pixels: np.ndarray, hdr: bool = True, **changes) -> ViewFigures:
    if hdr:
        write_exr(view.image, {"RGB" if pixels.shape[2] == 3 else "RGBA": pixels.astype(np.float32)})
        return measure(replace(view, **changes), hdr)
    path = view.image.with_suffix(".png")
    write_png(path, np.rint(255 * pixels.clip(0, 1)).astype(np.uint8))
    return measure(replace(view, image=path, **changes), hdr)


def test_luminance_and_range_are_linear_and_of_the_object(view: View) -> None:
    pixels = np.full((HEIGHT, WIDTH, 3), 7.0)
    pixels[20:40, 20:60] = np.exp2(np.linspace(-5, 3, 800)).reshape(20, 40, 1)
    measured = figures(view, pixels)
    assert measured.luminance == pytest.approx(np.exp2(-1), rel=0.01)
    assert measured.stops == pytest.approx(8 * (0.999 - 0.01), abs=0.05)
    assert measured.pixels == 800
    assert figures(view, pixels, exposure=4.0).luminance == pytest.approx(np.exp2(-3), rel=0.01)
    gray = np.full((HEIGHT, WIDTH, 3), 0.0)
    gray[20:40, 20:60] = 186 / 255
    assert figures(view, gray, hdr=False).luminance == pytest.approx(0.491, abs=0.002)  # of the sRGB curve


def test_luminance_follows_the_exposure_and_hardly_the_content(view: View) -> None:
    def seen(bright_rows: int, exposure: float = 1.0) -> float:
        pixels = exposure * (0.2 + 0.02 * NOISE)
        pixels[:bright_rows] *= 4.0
        return figures(view, pixels).luminance

    # Slightly more or less than half of the image is sky, like after a step to the side in a view without a
    # mask.
    assert seen(32) / seen(28) == pytest.approx(1.0, abs=0.15)
    assert seen(32, exposure=2.0) / seen(32) == pytest.approx(2.0, rel=1e-3)


def test_sharpness_falls_with_blur_and_not_with_exposure(view: View) -> None:
    sharp = figures(view, NOISE).sharpness
    assert figures(view, 0.1 * NOISE).sharpness == pytest.approx(sharp, rel=1e-3)
    blurred = [figures(view, cv2.GaussianBlur(NOISE, (0, 0), sigma)).sharpness for sigma in (0.7, 1.5, 3)]
    assert sharp > blurred[0] > blurred[1] > blurred[2]
    assert blurred[1] < 0.4 * sharp


def test_clipping_in_any_channel(view: View) -> None:
    for hdr, level in ((True, 0.62), (False, 1.0)):
        pixels = NOISE * (1 if hdr else 1.6)
        expected = (pixels >= level)[..., 1].mean()
        pixels[..., 1] = pixels[..., 1].clip(0, level)
        other = pixels[..., [0, 2]].clip(0, 0.99)
        pixels[..., [0, 2]] = other if not hdr else pixels[..., [0, 2]]
        assert 0.01 < expected < 0.5
        found = figures(view, pixels, hdr).clipped
        assert found == pytest.approx(expected, abs=0.005)
    assert figures(view, NOISE).clipped == 0


def test_an_even_image_is_not_clipped(view: View) -> None:
    pixels = np.full((HEIGHT, WIDTH, 3), 0.4)
    pixels[20:40, 20:60] = 0.7  # one flat object before a flat backdrop: nothing piles up, it is all there is
    assert figures(view, pixels).clipped == 0


def test_masks_and_broken_pixels(view: View, tmp_path: Path) -> None:
    pixels = NOISE.copy()
    pixels[:3] = np.nan
    pixels[3, :40] = -1
    measured = figures(view, pixels)
    assert measured.broken == pytest.approx((3 * WIDTH + 40) / (HEIGHT * WIDTH))
    assert np.isfinite([measured.luminance, measured.sharpness, measured.small.sum()]).all()
    valid = np.full((HEIGHT, WIDTH), 255, np.uint8)
    valid[:6] = 0
    write_png(tmp_path / "valid.png", valid)
    measured = figures(view, pixels, valid=tmp_path / "valid.png")
    assert (measured.broken, measured.invalid) == (0, pytest.approx(0.1))
    cut = np.concatenate([NOISE, np.zeros((HEIGHT, WIDTH, 1))], axis=2)
    cut[10:20, 10:20, 3] = 1
    measured = figures(view, cut)
    assert (measured.pixels, measured.object_from) == (100, "alpha channel")
    assert figures(view, NOISE).object_from == "nothing"


def test_unreadable_views_are_reported(view: View, tmp_path: Path) -> None:
    assert "no such image" in measure(view, True).unreadable
    write_png(tmp_path / "valid.png", np.full((3, 3), 255, np.uint8))
    assert "another size" in figures(view, NOISE, valid=tmp_path / "valid.png").unreadable
