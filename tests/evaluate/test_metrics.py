"""Each metric compared with a value that is computed by hand."""

from __future__ import annotations

import math

import numpy as np
import pytest
import trimesh

from neilfpp_method.evaluate import metrics

ALL = np.ones((1, 2), dtype=bool)
LEFT = np.array([[True, False]])


def image(*pixels: float) -> np.ndarray:
    """One row of grey pixels, (1, W, 1)."""
    return np.array(pixels, dtype=np.float32).reshape(1, -1, 1)


# ------------------------------------------------------------------------------------------------------- PSNR


def test_psnr_counts_only_masked_pixels():
    estimate, truth = image(0.5, 9.0), image(0.4, 0.0)
    assert metrics.psnr(estimate, truth, LEFT) == pytest.approx(
        10 * math.log10(1 / 0.1**2), abs=1e-4
    )  # 20 dB


def test_psnr_averages_the_squared_error_over_pixels_and_channels():
    estimate = np.array([[[0.1, 0.0], [0.0, 0.3]]])
    mse = (0.1**2 + 0.3**2) / 4
    assert metrics.psnr(estimate, np.zeros_like(estimate), ALL) == pytest.approx(-10 * math.log10(mse))


def test_psnr_rises_with_the_peak():
    estimate, truth = image(0.5, 0.5), image(0.4, 0.4)
    assert metrics.psnr(estimate, truth, ALL, peak=10.0) == pytest.approx(20.0 + 20.0, abs=1e-4)


def test_psnr_of_the_frame_counts_the_background_as_correct():
    estimate, truth = image(0.5, 9.0), image(0.4, 0.0)
    halved = metrics.psnr(estimate, truth, LEFT) + 10 * math.log10(2)
    assert metrics.psnr_frame(estimate, truth, LEFT) == pytest.approx(halved)


@pytest.mark.parametrize("measure", [metrics.psnr, metrics.psnr_frame])
def test_a_perfect_estimate_scores_100_db(measure):
    assert measure(image(0.3, 0.7), image(0.3, 0.7), ALL) == pytest.approx(100.0)


# ------------------------------------------------------------------------------------------------------- SSIM


def test_ssim_of_constant_images():
    a, b, stabilizer = 0.3, 0.6, 0.01**2
    estimate, truth = np.full((16, 16, 3), a), np.full((16, 16, 3), b)
    expected = (2 * a * b + stabilizer) / (
        a * a + b * b + stabilizer
    )  # without variance only the means are compared
    assert metrics.ssim(estimate, truth, np.ones((16, 16), bool)) == pytest.approx(expected, abs=1e-6)


def test_ssim_ignores_pixels_outside_the_mask():
    truth = np.random.default_rng(0).random((24, 24, 3))
    mask = np.zeros((24, 24), dtype=bool)
    mask[6:18, 6:18] = True
    estimate = np.where(mask[..., None], truth, 0.0)
    assert metrics.ssim(estimate, truth, mask) == pytest.approx(1.0)
    estimate[12, 12] = 1.0 - truth[12, 12]
    assert metrics.ssim(estimate, truth, mask) < 0.99


def test_ssim_needs_an_image_as_large_as_its_window():
    side = metrics.SSIM_WINDOW
    metrics.ssim(np.zeros((side, side, 1)), np.zeros((side, side, 1)), np.ones((side, side), bool))
    with pytest.raises(ValueError, match="win_size"):
        metrics.ssim(
            np.zeros((side, side - 1, 1)), np.zeros((side, side - 1, 1)), np.ones((side, side - 1), bool)
        )


# ---------------------------------------------------------------------------------------------------- normals


def test_angular_error_averages_where_both_have_a_normal():
    up, side, slanted, none = [0, 0, 1], [1, 0, 0], [0, 2, 2], [0, 0, 0]
    estimate = np.array([[up, up, none, up, up]], dtype=np.float32)
    truth = np.array([[side, slanted, up, none, side]], dtype=np.float32)
    mask = np.array([[True, True, True, True, False]])
    assert metrics.angular_error(estimate, truth, mask) == pytest.approx((90 + 45) / 2)


def test_angular_error_keeps_small_angles():
    angle = math.radians(1e-3)
    estimate, truth = np.array([[[math.sin(angle), 0, math.cos(angle)]]]), np.array([[[0.0, 0, 1]]])
    assert metrics.angular_error(estimate, truth, np.ones((1, 1), bool)) == pytest.approx(1e-3, rel=1e-6)


def test_angular_error_without_normals_is_nan():
    assert math.isnan(metrics.angular_error(np.zeros((1, 2, 3)), np.zeros((1, 2, 3)), ALL))


# -------------------------------------------------------------------------------------------------- alignment


def test_gamma_makes_the_medians_agree():
    estimate, truth = np.array([[0.1], [0.25], [0.9]]), np.array([[0.2], [0.5], [0.6]])
    gamma = metrics.align_gamma(estimate, truth)
    assert gamma == pytest.approx(0.5)  # ln 0.5 / ln 0.25
    assert np.median(estimate**gamma) == pytest.approx(0.5)


@pytest.mark.parametrize("median", [0.0, 1.0])
def test_gamma_is_finite_for_black_and_for_white(median):
    level, gray = np.full((3, 1), median), np.full((3, 1), 0.5)
    assert 0 < metrics.align_gamma(level, gray) < 1e3
    assert 0 < metrics.align_gamma(gray, level) < 1e3


def test_scale_is_the_least_squares_factor_of_each_channel():
    estimate = np.array([[1.0, 1.0, 0.0], [2.0, 1.0, 0.0]])
    truth = np.array([[2.0, 0.4, 0.7], [2.0, 0.6, 0.7]])
    expected = [(1 * 2 + 2 * 2) / (1 + 4), (0.4 + 0.6) / 2, 1.0]  # a channel that is black cannot be scaled
    assert metrics.align_scale(estimate, truth) == pytest.approx(expected)


# --------------------------------------------------------------------------------------------------- geometry


def test_chamfer_by_hand():
    estimate, truth = np.array([[0.0, 0, 0], [1, 0, 0]]), np.array([[0.0, 0, 0], [0, 0.5, 0], [0, -0.5, 0]])
    distances = metrics.chamfer(estimate, truth)
    assert distances.accuracy == pytest.approx((0 + 1) / 2)
    assert distances.completeness == pytest.approx((0 + 0.5 + 0.5) / 3)
    assert distances.mean == pytest.approx((1 / 2 + 1 / 3) / 2)


def test_chamfer_of_parallel_planes_is_their_distance():
    square = trimesh.Trimesh([[0, 0, 0], [1, 0, 0], [1, 1, 0], [0, 1, 0]], [[0, 1, 2], [0, 2, 3]])
    points = metrics.sample_surface(square, 60_000)
    assert metrics.chamfer(points + np.array([0, 0, 0.1]), points).mean == pytest.approx(0.1)
    other = metrics.sample_surface(square, 60_000, seed=1)
    assert metrics.chamfer(points, other).mean == pytest.approx(
        0.5 * math.sqrt(1 / 60_000), rel=0.05
    )  # the error of the sampling


def test_samples_are_spread_by_area_and_repeat():
    small, large = [[0, 0, 0], [1, 0, 0], [0, 1, 0]], [[2, 0, 0], [5, 0, 0], [2, 1, 0]]  # areas 1/2 and 3/2
    mesh = trimesh.Trimesh(small + large, [[0, 1, 2], [3, 4, 5]])
    points = metrics.sample_surface(mesh, 10_000, seed=3)
    assert (points[:, 0] >= 2).mean() == pytest.approx(3 / 4, abs=0.02)  # 4.6 standard deviations
    assert np.array_equal(points, metrics.sample_surface(mesh, 10_000, seed=3))


# ------------------------------------------------------------------------------------------------------ light


def test_log_error_of_a_factor():
    truth = np.array([[1.0, 4.0], [0.0, 0.0]])
    estimate = np.array([[2.0, 4.0], [0.0, 0.001]])
    floor = metrics.LOG_FLOOR
    expected = (math.log((2 + floor) / (1 + floor)) + 0 + 0 + math.log((0.001 + floor) / floor)) / 4
    assert metrics.log_error(metrics.log_ratio(estimate, truth)) == pytest.approx(expected)


def test_log_error_is_symmetric_in_too_much_and_too_little():
    a, b = np.array([[0.5]]), np.array([[8.0]])
    assert metrics.log_error(metrics.log_ratio(a, b)) == metrics.log_error(metrics.log_ratio(b, a))
