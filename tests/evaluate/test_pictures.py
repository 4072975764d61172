"""Images for display: known values give known pixels."""

from __future__ import annotations

import numpy as np
import pytest

from neilfpp_method.drawing.ink import PAPER
from neilfpp_method.evaluate.contact_sheet import Group, PictureRow, Section, contact_sheet
from neilfpp_method.evaluate.pictures import (
    auto_exposure,
    cut_out,
    display,
    display_color,
    display_error,
    lat_long_directions,
    nearest_radiance,
)


def flat(*values: float) -> np.ndarray:
    return np.broadcast_to(np.array(values, dtype=np.float32), (4, 6, len(values))).copy()


@pytest.mark.parametrize(
    ("name", "values", "expected"),
    [
        ("rgb", (0.0, 0.5, 7.0), (0, 188, 255)),  # sRGB of 0.5 is 0.7354; radiance above 1 clips
        ("base_color", (0.0, 0.5, 1.0), (0, 188, 255)),
        ("roughness", (0.5,), (128,)),  # no curve: 127.5 rounds to the even 128
        ("metallic", (1.0,), (255,)),
        ("normal", (0.0, -1.0, 1.0), (128, 0, 255)),
        ("rgb", (float("nan"), float("inf"), -1.0), (0, 255, 0)),
    ],
)
def test_display_of_each_kind_of_map(name: str, values: tuple[float, ...], expected: tuple[int, ...]):
    shown = display(name, flat(*values))
    assert shown.dtype == np.uint8
    np.testing.assert_array_equal(shown[2, 3], expected)


def test_depth_is_white_near_and_black_far():
    depth = np.linspace(1.0, 3.0, 101, dtype=np.float32).reshape(1, 101, 1)
    shown = display("depth", depth)[0, :, 0]
    assert shown[0] == 255
    assert shown[-1] == 0
    assert shown[50] == pytest.approx(127.5, abs=1)
    assert display("depth", flat(2.0)).shape == (4, 6, 1)  # a constant depth does not divide by zero


def test_exposure_scales_before_clipping():
    np.testing.assert_array_equal(
        display_color(flat(1.0, 2.0, 4.0), 0.25)[0, 0], display_color(flat(0.25, 0.5, 1.0))[0, 0]
    )


def test_auto_exposure_ignores_lamps():
    radiance = np.full((100, 3), 0.2)
    radiance[:5] = 1000.0
    assert auto_exposure(radiance) == pytest.approx(0.7 / 0.2)
    assert np.isfinite(auto_exposure(np.zeros((10, 3))))


def test_error_grows_brighter():
    shown = display_error(np.array([[0.0, 0.1, 0.2, 9.0]]), 0.2).astype(int).sum(-1)[0]
    assert shown[0] < shown[1] < shown[2] == shown[3]


def test_cut_out_shows_the_background_outside_the_mask():
    mask = np.zeros((4, 6), dtype=bool)
    mask[1, 2] = True
    shown = cut_out(np.full((4, 6, 1), 7, dtype=np.uint8), mask)
    assert tuple(shown[1, 2]) == (7, 7, 7)
    assert tuple(shown[0, 0]) == PAPER


# --------------------------------------------------------------------------------------------- incident light


def test_lat_long_covers_the_sphere():
    directions = lat_long_directions(64)
    assert directions.shape == (64, 128, 3)
    np.testing.assert_allclose(np.linalg.norm(directions, axis=-1), 1.0, atol=1e-6)
    # ∫ z² dω = 4π/3, with dω = sin θ dθ dφ.
    sine = np.sqrt(1.0 - directions[..., 2] ** 2)
    integral = (directions[..., 2] ** 2 * sine).sum() * (np.pi / 64) ** 2
    assert integral == pytest.approx(4.0 * np.pi / 3.0, rel=1e-3)


@pytest.mark.parametrize(("row", "column"), [(10, 5), (32, 100), (50, 64)])
def test_directional_light_peaks_in_its_pixel(row: int, column: int):
    # Row j is at θ = π (j + ½)/64, column i at φ = 2π (i + ½)/128, as an environment map's direction is
    # written.
    theta, phi = np.pi * (row + 0.5) / 64, 2.0 * np.pi * (column + 0.5) / 128
    light = np.array([np.sin(phi) * np.sin(theta), np.cos(phi) * np.sin(theta), np.cos(theta)])
    directions = lat_long_directions(64)
    radiance = np.exp(200.0 * (directions @ light - 1.0))
    assert np.unravel_index(radiance.argmax(), radiance.shape) == (row, column)
    # The same light, known along scattered directions only.
    scattered = np.random.default_rng(0).normal(size=(20_000, 3))
    wi = scattered / np.linalg.norm(scattered, axis=-1, keepdims=True)
    known = np.repeat(np.exp(200.0 * (wi @ light - 1.0))[:, None], 3, axis=1)
    looked_up = nearest_radiance(wi, known, directions)[..., 0]
    peak = np.unravel_index(looked_up.argmax(), looked_up.shape)
    # 20,000 directions lie 1.4° apart, a pixel is 2.8° high.
    assert directions[peak] @ light > np.cos(np.radians(3.0))


# ---------------------------------------------------------------------------------------------- contact sheet


def sheet(value: int, rows: int = 2) -> np.ndarray:
    picture = np.full((30, 40, 3), value, dtype=np.uint8)
    row = PictureRow("base colour", (picture, picture[..., :1], None), "as estimated", "0.2")
    return contact_sheet(
        "a run", "fast", [Section((Group("view 004", ("truth", "estimate", "error")),), rows * (row,))], 160
    )


def test_contact_sheet_has_the_size_of_its_cells():
    small, large = sheet(9, rows=1), sheet(9, rows=3)
    assert small.shape[1] == large.shape[1]
    # A cell of 160 × 120 (the picture is 4:3) and a gap of 8 a row.
    assert large.shape[0] - small.shape[0] == 2 * (120 + 8)
    assert small.shape[1] >= 3 * 160 + 2 * 8


def test_contact_sheet_shows_its_pictures():
    dark, bright = sheet(10), sheet(200)
    assert dark.shape == bright.shape
    differing = (dark != bright).any(-1)
    # Two pictures in each of two rows, and nothing else, differ.
    assert differing.sum() == 2 * 2 * 160 * 120
    assert (dark[differing] == 10).all()
