"""Figures that compare views, with closed forms and with images that are alike on purpose."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest

from neilfpp_method.data.capture import load_capture
from neilfpp_method.inspection.relations import (
    CameraPlacement,
    camera_placement,
    duplicates,
    exposure_factors,
)
from tests.data.make_capture import DISTANCE, SCALE, make_capture


def ring(count: int) -> CameraPlacement:
    """Cameras on a circle that look inwards."""
    azimuth = 2 * np.pi * np.arange(count) / count
    outward = np.stack([np.cos(azimuth), np.sin(azimuth), np.zeros(count)], axis=1)
    none = np.zeros(count, bool)
    return CameraPlacement(3 * outward, -outward, none, none, 1.0, 360 / count)


def test_a_jump_is_distinguished_from_a_slow_change() -> None:
    slow = 1 + 0.5 * np.sin(2 * np.pi * np.arange(24) / 24)
    assert np.allclose(exposure_factors(slow.tolist(), ring(24)), 1, atol=0.15)
    for i in (0, 7):
        light = slow.copy()
        light[i] *= 4
        factors = exposure_factors(light.tolist(), ring(24))
        assert factors[i] == pytest.approx(4, rel=0.15)
        assert np.allclose(np.delete(factors, i), 1, atol=0.15), "its neighbours stay out of it"


def test_an_object_with_a_bright_and_a_dark_side_has_no_jump() -> None:
    """A view has three bright neighbours and farther dark ones, like view 021 of `spot_paint`."""
    angle = np.radians([0, 10, 20, 30, 50, 60, 70, 80])
    outward = np.stack([np.cos(angle), np.sin(angle), np.zeros(8)], axis=1)
    placement = replace(ring(8), centers=3 * outward, axes=-outward)
    light = np.where(np.arange(8) < 4, 0.5, 0.27)
    assert exposure_factors(light.tolist(), placement)[0] == pytest.approx(1)
    light[0] *= 2
    assert exposure_factors(light.tolist(), placement)[0] == pytest.approx(2)
    assert exposure_factors([1.0, 0.4, 1.0], ring(3)).tolist() == [1, 1, 1], "120° apart"


def test_black_views_and_single_views_have_no_factor() -> None:
    assert exposure_factors([2.0], ring(1)).tolist() == [1]
    assert exposure_factors([2.0, 0.0, *[2.0] * 14], ring(16)).tolist() == [1] * 16


def test_duplicates_survive_compression_size_and_brightness() -> None:
    rng = np.random.default_rng(0)
    flat = [cv2.GaussianBlur(rng.uniform(0, 1, (90, 120, 3)).astype(np.float32), (0, 0), 6) for _ in range(4)]
    pictures = [cv2.normalize(picture, None, 0, 1, cv2.NORM_MINMAX) for picture in flat]
    small = cv2.resize(pictures[2], (60, 45), interpolation=cv2.INTER_AREA)
    rough = (
        (np.rint(pictures[1] * 255 + rng.normal(0, 2, pictures[1].shape)) / 255).clip(0).astype(np.float32)
    )
    shifted = np.roll(pictures[0], 6, axis=1)
    black = np.zeros_like(small)
    assert duplicates([*pictures, 0.5 * small, rough, shifted, black, black]) == ((1, 5), (2, 4))


def test_a_bright_pixel_makes_no_duplicates() -> None:
    rng = np.random.default_rng(0)
    pictures = [
        cv2.GaussianBlur(rng.uniform(0, 1, (90, 120, 3)).astype(np.float32), (0, 0), 6) for _ in range(3)
    ]
    for picture in pictures:
        picture[2, 2] = 65_504.0
    assert duplicates([*pictures, pictures[1]]) == ((1, 3),)


def test_coverage_by_cameras(tmp_path: Path) -> None:
    capture = load_capture(make_capture(tmp_path, views=12))
    placement = camera_placement(capture)
    assert not placement.away.any()
    assert not placement.within.any()
    assert np.allclose(np.linalg.norm(placement.centers, axis=1), DISTANCE / SCALE)
    assert np.allclose(
        placement.axes,
        -placement.centers / np.linalg.norm(placement.centers, axis=1, keepdims=True),
        atol=1e-9,
    )
    one = camera_placement(replace(capture, views=capture.views[:1]))
    cap = (1 - np.cos(np.radians(30))) / 2  # the share of the sphere within 30° of a direction
    assert one.coverage == pytest.approx(cap, abs=2e-3)


def test_a_camera_shifted_out_of_the_picture_looks_away(tmp_path: Path) -> None:
    capture = load_capture(make_capture(tmp_path))
    view = capture.views[1]
    off = replace(view, camera=replace(view.camera, cx=view.camera.width + 0.5))
    edge = replace(view, camera=replace(view.camera, cx=view.camera.width - 0.5))
    assert camera_placement(replace(capture, views=(view, off, edge))).away.tolist() == [False, True, False]
