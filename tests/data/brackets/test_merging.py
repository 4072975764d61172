"""Exposure brackets, simulated from known radiance with a known camera response, are merged to that
radiance.
"""

from __future__ import annotations

import cv2
import numpy as np
import pytest

from neilfpp_method.data.brackets.merging import Bracket, calibrate, linear_response, merge, srgb_response
from neilfpp_method.errors import UserError
from tests.data.make_capture import srgb

TIMES = (1 / 256, 1 / 64, 1 / 16, 1 / 4, 1.0)


def scene(seed: int = 0, size: tuple[int, int] = (48, 64)) -> np.ndarray:
    """Smooth coloured radiance over 13 stops: 0.016 to 128, where the 1 s exposure clips at 1."""
    height, width = size
    v, u = np.mgrid[:height, :width] / np.array([height, width]).reshape(2, 1, 1)
    stops = -6.0 + 13.0 * (0.5 + 0.3 * np.sin(9 * u + seed) * np.cos(7 * v) + 0.2 * (u - v))
    tint = np.stack([1.0 + 0.2 * np.sin(5 * u), np.ones_like(u), 1.0 - 0.3 * v], axis=-1)
    return (np.exp2(stops)[..., None] * tint).astype(np.float32)


def film(light: np.ndarray) -> np.ndarray:
    """Response of another camera: a gamma of 1/2.2 with a soft S-curve."""
    z = light.clip(0, 1) ** (1 / 2.2)
    return z + 0.08 * np.sin(2 * np.pi * z) / (2 * np.pi)


CURVES = {"srgb": srgb, "film": film, "linear": lambda light: light.clip(0, 1)}


def photographs(
    radiance: np.ndarray, curve: str, times: tuple[float, ...] = TIMES, levels: int = 255
) -> list[np.ndarray]:
    return [
        np.rint(levels * CURVES[curve](radiance * t)).astype(np.float32) / np.float32(levels) for t in times
    ]


def relative_error(found: np.ndarray, truth: np.ndarray) -> np.ndarray:
    """Relative error after one global scale factor."""
    return np.abs(found / np.median(found / truth) / truth - 1)


# ------------------------------------------------------------------------------------------------------ merge


@pytest.mark.parametrize(("curve", "levels"), [("srgb", 255), ("linear", 65_535)])
def test_a_known_response_recovers_the_radiance(curve: str, levels: int) -> None:
    truth = scene()
    response = srgb_response if curve == "srgb" else linear_response
    merged = merge(Bracket(tuple(photographs(truth, curve, levels=levels)), TIMES), response)
    bright = truth > 12 / 255  # a level of the longest exposure is then less than the 2 %
    assert merged.valid.mean() > 0.9
    assert (relative_error(merged.radiance, truth)[bright & merged.valid[..., None]] < 0.02).all()
    assert np.median(merged.radiance / truth) == pytest.approx(1, abs=0.005)  # in the unit of the response


@pytest.mark.parametrize("curve", ["srgb", "film"])
def test_a_calibrated_response_recovers_the_radiance(curve: str) -> None:
    poses = [scene(seed) for seed in range(3)]
    stacks = [Bracket(tuple(photographs(truth, curve)), TIMES) for truth in poses]
    response = calibrate(stacks)
    for truth, stack in zip(poses, stacks, strict=True):
        merged = merge(stack, response)
        error = relative_error(merged.radiance, truth)[merged.valid & (truth.min(-1) > 12 / 255)]
        assert np.quantile(error, 0.99) < 0.02
        assert np.median(error) < 0.006


def test_pixels_clipped_at_every_exposure_are_lower_bounds_and_invalid() -> None:
    truth = np.ones((4, 4, 3), np.float32)
    truth[0, 0] = [1, 1, 500]  # one channel is enough
    merged = merge(Bracket(tuple(photographs(truth, "linear")), TIMES), linear_response)
    assert not merged.valid[0, 0]
    assert merged.valid.sum() == 15
    assert merged.radiance[0, 0, 2] == pytest.approx(256)
    assert merged.radiance[0, 0, 0] == pytest.approx(1, rel=0.02)


def test_pixels_dark_at_every_exposure_are_almost_black_and_valid() -> None:
    truth = np.full((4, 4, 3), 0.01, np.float32)
    truth[0, 0] = 0
    merged = merge(Bracket(tuple(photographs(truth, "linear")), TIMES), linear_response)
    assert merged.valid.all()
    assert (merged.radiance[0, 0] == 0).all()
    assert np.allclose(merged.radiance[1:], 0.01, atol=0.5 / 255)


def test_between_exposures_too_far_apart_the_unclipped_one_counts() -> None:
    truth = np.full((1, 1, 3), 2.0, np.float32)
    merged = merge(
        Bracket(tuple(photographs(truth, "linear", (1.0, 1 / 256))), (1.0, 1 / 256)), linear_response
    )
    assert np.allclose(merged.radiance, 2.0, atol=256 * 0.5 / 255)
    assert merged.valid.all()


def test_opencv_agrees_where_nothing_is_clipped() -> None:
    truth = np.exp2(np.linspace(-1.5, 1, 3 * 1024)).reshape(32, 32, 3).astype(np.float32)
    times = (1 / 8, 1 / 4, 3 / 8)
    stack = photographs(truth, "srgb", times)
    curve = srgb_response(np.linspace(0, 1, 256, dtype=np.float32).reshape(256, 1, 1).repeat(3, 2))
    bytes_ = [np.rint(255 * image).astype(np.uint8) for image in stack]
    theirs = cv2.createMergeDebevec().process(bytes_, np.array(times, np.float32), curve.clip(1e-6))
    ours = merge(Bracket(tuple(stack), times), srgb_response).radiance
    assert np.median(np.abs(ours / theirs - 1)) < 0.005


def test_exposures_that_determine_no_response_are_refused() -> None:
    same = np.random.default_rng(0).uniform(0, 1, (16, 16, 3)).astype(np.float32)
    stack = Bracket((same, same[::-1].copy(), same[:, ::-1].copy()), (1.0, 2.0, 4.0))  # noise, not light
    with pytest.raises(UserError, match="response cannot be calibrated"):
        calibrate([stack])
