"""Held-back patches of training views are never drawn: on the object, few, and the same for the same seed."""

from __future__ import annotations

import numpy as np
import torch

from neilfpp_method.data.capture import load_capture
from neilfpp_method.data.pixels.dataset import PixelDataset
from neilfpp_method.data.pixels.held_back import MAX_SHARE, PATCHES, SIDE, hold_back
from tests.data.make_capture import make_capture


def dataset(root, **options) -> PixelDataset:
    capture = load_capture(make_capture(root, **options))
    return PixelDataset(capture, capture.train_views)


def left_out(pixels: PixelDataset) -> np.ndarray:
    return pixels._draws._left_out.numpy()


def test_patches_are_squares_on_the_object(tmp_path):
    pixels = dataset(tmp_path / "sphere", size=(96, 72), masks=True)
    held_back = hold_back(pixels, seed=3)
    numbers = left_out(pixels)
    assert len(numbers) == PATCHES * SIDE**2
    of_view = np.searchsorted(pixels.store.starts, numbers, side="right") - 1
    row, column = np.divmod(numbers - pixels.store.starts[of_view], 96)
    # Every pixel that is left out lies in a square of 4×4 such pixels.
    for view in set(of_view.tolist()):
        image = np.zeros((72, 96), bool)
        image[row[of_view == view], column[of_view == view]] = True
        squares = np.lib.stride_tricks.sliding_window_view(image, (SIDE, SIDE)).all((2, 3))
        covered = np.zeros_like(image)
        for top, left in np.argwhere(squares):
            covered[top : top + SIDE, left : left + SIDE] = True
        assert (covered == image).all()
    assert np.bincount(of_view).max() <= 4 * SIDE**2  # 16 patches on 5 views
    assert (held_back.mask > 0.5).all()
    assert 0.8 * len(numbers) < len(held_back) <= len(numbers)


def test_held_back_pixels_are_never_drawn_and_all_others_are(tmp_path):
    pixels = dataset(tmp_path / "sphere", size=(32, 24), masks=True)
    hold_back(pixels, seed=0)
    torch.manual_seed(0)
    drawn = np.unique(pixels.draw(200_000).numpy())
    valid = np.arange(len(pixels))  # make_capture marks none as invalid
    assert not set(drawn) & set(left_out(pixels))
    assert set(drawn) == set(valid) - set(left_out(pixels))
    assert 0 < len(left_out(pixels)) <= MAX_SHARE * len(pixels)


def test_the_remaining_pixels_are_equally_likely(tmp_path):
    """Without masks and with a varying background, no pixel is preferred."""
    pixels = dataset(tmp_path / "sphere", size=(32, 24))
    pixels._draws._parts = None
    hold_back(pixels, seed=0)
    torch.manual_seed(1)
    counts = np.bincount(pixels.draw(400 * len(pixels)).numpy(), minlength=len(pixels))
    free = np.setdiff1d(np.arange(len(pixels)), left_out(pixels))
    expected = 400 * len(pixels) / len(free)
    # Five standard deviations of a Poisson count.
    assert np.abs(counts[free] - expected).max() < 5 * np.sqrt(expected)
    assert counts[left_out(pixels)].sum() == 0


def test_the_choice_depends_on_the_seed_and_uses_no_other_random_numbers(tmp_path):
    root = tmp_path / "sphere"
    one = dataset(root, size=(64, 48))
    capture = one.capture
    again, other = (PixelDataset(capture, capture.train_views) for _ in range(2))
    torch.manual_seed(7)
    before = torch.get_rng_state()
    first = hold_back(one, seed=1)
    assert torch.equal(torch.get_rng_state(), before)
    assert torch.equal(hold_back(again, seed=1).color, first.color)
    assert not np.array_equal(left_out(one), _left_out_with(other, seed=2))


def _left_out_with(pixels: PixelDataset, seed: int) -> np.ndarray:
    hold_back(pixels, seed)
    return left_out(pixels)


def test_nothing_is_held_back_from_a_very_small_capture(tmp_path):
    pixels = dataset(tmp_path / "sphere", size=(8, 6), views=3, masks=True)
    assert len(hold_back(pixels, seed=0)) == 0
    assert len(pixels.sample(10)) == 10
