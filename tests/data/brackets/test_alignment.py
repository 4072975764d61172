"""Handheld brackets: the camera rotates between the exposures of a scene with known radiance."""

from __future__ import annotations

import cv2
import numpy as np
import pytest

from neilfpp_method.data.brackets.alignment import align
from neilfpp_method.data.brackets.merging import Bracket, calibrate, merge, srgb_response
from tests.data.brackets.test_merging import photographs, relative_error
from tests.prepare.textured_corner import photograph, pose

TIMES = (1 / 32, 1 / 10, 1 / 3)
SIZE = (240, 180)
STILL = ((0.0, 0.0, 0.0),) * 3
HAND = ((0.6, -0.8, 0.5), (0.0, 0.0, 0.0), (-0.7, 0.5, -0.4))
"""Rotations about the camera's axes, degrees."""


def radiance(turn: tuple[float, ...], view: int = 2) -> np.ndarray:
    """The corner as seen through a lens, without detail finer than a pixel."""
    w2c = np.eye(4)
    w2c[:3, :3] = cv2.Rodrigues(np.radians(turn))[0]
    fine = photograph(w2c @ pose(view, 8), (4 * SIZE[0], 4 * SIZE[1]))
    return cv2.resize(cv2.GaussianBlur(4.0 * fine, (0, 0), 5.0), SIZE, interpolation=cv2.INTER_AREA)


def bracket(turns: tuple[tuple[float, ...], ...], curve: str = "srgb", view: int = 2) -> Bracket:
    images = [
        photographs(radiance(turn, view), curve, (time,))[0] for turn, time in zip(turns, TIMES, strict=True)
    ]
    return Bracket(tuple(images), TIMES)


def true_motion(turn: tuple[float, ...]) -> float:
    """Largest motion, in pixels, of an image corner by a rotation of the camera."""
    k = np.array([[1.25 * SIZE[0], 0, SIZE[0] / 2], [0, 1.25 * SIZE[0], SIZE[1] / 2], [0, 0, 1]])
    corners = np.array([[[x, y] for x in (0.5, SIZE[0] - 0.5) for y in (0.5, SIZE[1] - 0.5)]])
    motion = k @ cv2.Rodrigues(np.radians(turn))[0] @ np.linalg.inv(k)
    return float(np.linalg.norm(cv2.perspectiveTransform(corners, motion) - corners, axis=-1).max())


def errors(stack: Bracket, response=srgb_response) -> np.ndarray:
    truth = radiance(HAND[1])
    merged = merge(stack, response)
    assert merged.valid.mean() > 0.95
    return relative_error(merged.radiance, truth)[merged.valid & (truth.min(-1) > 0.15)]


def test_a_bracket_from_a_tripod_is_unchanged() -> None:
    stack = bracket(STILL)
    aligned = align(stack)
    assert aligned.moved == 0
    assert aligned.bracket.pixels == stack.pixels


def test_a_handheld_bracket_is_aligned() -> None:
    stack = bracket(HAND)
    aligned = align(stack)
    assert aligned.moved == pytest.approx(max(true_motion(HAND[0]), true_motion(HAND[2])), abs=0.1)
    assert aligned.bracket.pixels[1] is stack.pixels[1]  # the middle one stays
    error = errors(aligned.bracket)
    assert np.quantile(error, 0.95) < 0.02
    assert np.median(error) < 0.006
    assert np.median(errors(stack)) > 0.05  # as it was


def test_the_response_is_calibrated_from_handheld_brackets() -> None:
    stacks = [align(bracket(HAND, "film", view)).bracket for view in (2, 5)]
    error = errors(stacks[0], calibrate(stacks))
    assert np.median(error) < 0.02
    assert np.quantile(error, 0.95) < 0.05


def test_pixels_outside_a_moved_image_come_from_the_other_exposures() -> None:
    turns = ((0.0, 4.0, 0.0), (0.0, 0.0, 0.0), (0.0, 0.0, 0.0))
    aligned = align(bracket(turns))
    assert aligned.moved > 15
    unseen = (aligned.bracket.pixels[0] == 1).all(axis=(0, 2))
    assert 12 <= unseen.sum() <= 30  # columns at one side
    merged = merge(aligned.bracket, srgb_response)
    truth = radiance(turns[1])
    shown = merged.valid[:, unseen] & (truth[:, unseen].min(-1) > 0.15)
    assert shown.sum() > 1000
    assert np.median(relative_error(merged.radiance[:, unseen], truth[:, unseen])[shown]) < 0.01


def test_images_without_detail_are_unchanged() -> None:
    gray = tuple(np.full((40, 60, 3), level, np.float32) for level in (0.1, 0.3, 0.8))
    assert align(Bracket(gray, TIMES)).moved == 0
    noise = tuple(
        np.random.default_rng(i).uniform(0.1, 0.9, (90, 120, 3)).astype(np.float32) for i in range(3)
    )
    assert align(Bracket(noise, TIMES)).moved == 0
    black = tuple(np.zeros((40, 60, 3), np.float32) for _ in range(2))
    assert align(Bracket(black, TIMES[:2])).moved == 0
