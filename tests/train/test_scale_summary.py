"""The line of `neilfpp train` about scaled images."""

from __future__ import annotations

import pytest

from neilfpp_method.train.command import _scale_summary


@pytest.mark.parametrize(
    ("pixels", "words"), [(2_345_678, "2.3 million"), (45_678, "46 thousand"), (812, "1 thousand")]
)
def test_small_captures_do_not_have_0_million_pixels(pixels: int, words: str) -> None:
    found = _scale_summary(0.5, pixels, rays=8_000_000)
    assert found.startswith(f"images scaled to 0.5 of their size: {words} pixels for 8.0 million rays;")
