"""The split of a capture into training views and test views, which are held out from training."""

from __future__ import annotations

import json
from collections.abc import Collection, Sequence
from pathlib import Path

from neilfpp_method.data.files.paths import inside
from neilfpp_method.data.views import CaptureFiles, View
from neilfpp_method.errors import UserError

__all__ = ["TEST_EVERY", "check_test_every", "every_kth", "held_out_views"]

FILE = "split.json"
"""File of a capture with the names or numbers of its test views."""

TEST_EVERY = 8
"""Default split: every 8th view is a test view, as in mip-NeRF 360 and many papers after it."""


def held_out_views(
    root: Path, files: CaptureFiles, test_every: int | None, test: Collection[str | int] | None
) -> frozenset[str]:
    """Return the names of the test views of a capture.

    The first of these decides that is given: `test`, `test_every`, the file `split.json`, the capture's own
    layout. Otherwise every 8th view is held out.

    Args:
        root: folder of the capture.
        files: the content of the folder.
        test_every: hold out every k-th view, from the k-th on; 0 holds out no view.
        test: hold out these views, by name or by number.

    Raises:
        UserError: a view that is named does not exist, no view would remain, or `split.json` is malformed.
    """
    views, split = files.views, root / FILE
    if test is not None:
        held_out = _named(views, test, "test")
    elif test_every is None and split.is_file():
        held_out = _named(views, _read_split(inside(root, split)), str(split))
    elif test_every is None and files.test is not None:
        held_out = _named(views, files.test, "the capture's own split")
    else:
        held_out = every_kth(views, test_every)
    if len(held_out) == len(views):
        raise UserError(f"{root}: all {len(views)} views are held out for testing", "leave some to train on")
    return held_out


def every_kth(views: Sequence[View], k: int | None) -> frozenset[str]:
    """Return the names of every k-th view, from the k-th on.

    Args:
        views: the views, in order.
        k: 2 or more; 0 holds out no view, and None every 8th.

    Raises:
        UserError: as `check_test_every`.
    """
    k = TEST_EVERY if k is None else k
    check_test_every(k)
    return frozenset(view.name for view in views[k - 1 :: k]) if k else frozenset()


def check_test_every(k: int | None) -> None:
    """Check the value of an option --test-every.

    Raises:
        UserError: it is 1 or negative.
    """
    if k is not None and (k < 0 or k == 1):
        raise UserError(f"every {k}-th view cannot be held out", "give 2 or more, or 0 to hold out no view")


def _named(views: Sequence[View], wanted: Collection[str | int], where: str) -> frozenset[str]:
    """Names of views that are given by name or by number."""
    names = {**{view.index: view.name for view in views}, **{view.name: view.name for view in views}}
    for key in wanted:
        if key not in names:
            raise UserError(f"{where}: there is no view {key!r}", "name views by image name or number")
    return frozenset(names[key] for key in wanted)


def _read_split(path: Path) -> list[str | int]:
    try:
        test = json.loads(path.read_text("utf-8-sig"))["test"]
    except (ValueError, OSError, RecursionError, KeyError, TypeError) as error:
        raise UserError(
            f"{path}: not a JSON object with the key 'test' ({error})", 'write {"test": [0, 8]}'
        ) from error
    if not isinstance(test, list) or not all(isinstance(key, str | int) for key in test):
        raise UserError(f"{path}: 'test' is not a list of view names or numbers", 'write {"test": [0, 8]}')
    return test
