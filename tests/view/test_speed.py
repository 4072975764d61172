"""The sizes of the images that the viewer renders, from the measured speed."""

from __future__ import annotations

import pytest

from neilfpp_method.view.speed import BATCH_SECONDS, FIRST_IMAGE_SECONDS, RenderSpeed, sizes


def test_sizes_double_up_to_the_whole_window():
    assert sizes(640, 480, 19_200) == [0.25, 0.5, 1.0]  # 640 · 480 / 16 = 19,200
    assert sizes(640, 480, 640 * 480) == [1.0]
    assert sizes(640, 480, 10**9) == [1.0]


def test_the_first_image_is_small_enough_to_appear_immediately():
    for at_once in (300, 5_000, 80_000):
        first = sizes(1280, 720, at_once)[0]
        assert at_once / 4.1 < first**2 * 1280 * 720 <= at_once * 1.01


def test_the_number_of_rays_follows_the_measured_speed():
    speed = RenderSpeed()
    speed.note("normal", 100_000, 1.0)
    assert speed.first_image("normal") == int(100_000 * FIRST_IMAGE_SECONDS)
    speed.note("normal", 300_000, 1.0)  # the mean of both: 200,000 per second
    assert speed.first_image("normal") == int(200_000 * FIRST_IMAGE_SECONDS)
    assert speed.batch("normal") == pytest.approx(200_000 * BATCH_SECONDS)
    speed.note("radiance", 1, 1.0)  # separately for each layer, and never 0
    assert speed.first_image("radiance") == 256
    assert speed.first_image("normal") == int(200_000 * FIRST_IMAGE_SECONDS)
