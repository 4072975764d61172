"""Structure from motion gives the same poses on every machine."""

from __future__ import annotations

import pytest

from neilfpp_method.prepare.mapping import _options


@pytest.mark.parametrize(("images", "threads"), [(9, 1), (200, 1), (201, -1)])
def test_poses_do_not_depend_on_the_number_of_processors(images: int, threads: int) -> None:
    """Nine images of `textured_corner` have other poses with two threads than with one, in the last bits, and
    with two threads one of seven runs differs from the others.
    """
    assert _options(images).num_threads == threads
