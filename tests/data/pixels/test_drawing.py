"""Drawing the pixels of a step: selection of the k-th of a set, shares on and off the object, and dependence
on the seed.
"""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from scipy import stats

from neilfpp_method.data.capture import load_capture
from neilfpp_method.data.pixels.dataset import PixelDataset
from neilfpp_method.data.pixels.drawing import BLOCK, MASK, NEAR, NEAR_SHARE, VALID, PixelDraws, PixelSet
from tests.data.make_capture import make_capture


def padded(bits: np.ndarray) -> np.ndarray:
    return np.pad(bits.astype(np.uint8), (0, -len(bits) % BLOCK))


@pytest.mark.parametrize("count", [1, BLOCK - 1, BLOCK, BLOCK + 1, 20_000])
def test_the_kth_pixel_of_a_set_is_selected(count: int) -> None:
    bits = np.random.default_rng(count).integers(0, 16, count)
    bits[-1] = VALID | NEAR
    for having, lacking in ((VALID, 0), (VALID | NEAR, 0), (VALID, NEAR)):
        chosen = PixelSet(padded(bits), having, lacking)
        expected = np.flatnonzero(((bits & having) == having) & ((bits & lacking) == 0))
        assert chosen.count == len(expected)
        assert np.array_equal(chosen.find(torch.arange(chosen.count)).numpy(), expected)


def test_shares_near_the_object_and_beside_it() -> None:
    random = np.random.default_rng(0)
    near, valid = random.random(50_000) < 0.1, random.random(50_000) < 0.7
    draws = PixelDraws(padded(np.where(near, NEAR | MASK, 0) | np.where(valid, VALID, 0)), 50_000)
    numbers = draws.draw(40_000).numpy()
    assert valid[numbers].all()
    assert near[numbers].sum() == round(NEAR_SHARE * 40_000)
    for chosen in (near & valid, ~near & valid):  # within each, every pixel is as likely as any other
        drawn = np.bincount(numbers, minlength=50_000)[chosen]
        assert stats.chisquare(np.add.reduceat(drawn, np.arange(0, len(drawn) - 9, 10))[:-1]).pvalue > 1e-3
    # A step may use only its first pixels, so they must have the same distribution as the rest.
    assert stats.binomtest(int(near[numbers[:10_000]].sum()), 10_000, NEAR_SHARE).pvalue > 1e-3


def test_draws_are_uniform_if_nearly_all_pixels_are_near() -> None:
    near = np.arange(5000) < 4500
    draws = PixelDraws(padded(np.where(near, NEAR, 0) | VALID), 5000)
    torch.manual_seed(5)
    numbers = draws.draw(300)
    torch.manual_seed(5)
    assert torch.equal(numbers, torch.randint(5000, (300,)))


def test_draws_of_a_capture_with_masks(tmp_path: Path) -> None:
    capture = load_capture(make_capture(tmp_path, views=8, size=(96, 72), masks=True))
    pixels = PixelDataset(capture, capture.views)
    near = torch.cat([pixels.near(i) for i in range(8)])
    on_object = torch.cat([pixels.view(i).mask > 0 for i in range(8)])
    assert near[on_object].all()
    assert on_object.float().mean() < near.float().mean() < NEAR_SHARE
    assert near[pixels.draw(1000)].sum() == round(NEAR_SHARE * 1000)


def test_views_without_a_mask_among_others_are_drawn_like_the_object(tmp_path: Path) -> None:
    capture = load_capture(make_capture(tmp_path, masks=True))
    pixels = PixelDataset(capture, [replace(capture.views[0], mask=None), *capture.views[1:]])
    assert pixels.near(0).all()
    assert not pixels.near(1).all()
    assert not pixels.view(0).mask_known.any()
