"""Which views all runs of a comparison can show, and where they do not agree about them."""

from __future__ import annotations

import filecmp
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from neilfpp_method.compare.contenders import Contender
from neilfpp_method.data.capture import Capture
from neilfpp_method.data.scaling import at_scale, file_size
from neilfpp_method.data.views import View
from neilfpp_method.report.views import evenly_spread

__all__ = ["Common", "capture_to_show", "common_views", "same_cameras"]

POSE_TOLERANCE = 1e-3
"""Largest difference between two poses of the same view, in entries of a rotation and in scene units."""
FIELD_TOLERANCE = 1e-2
"""Largest difference between two focal lengths of the same view, over the width of the image."""


@dataclass(frozen=True)
class Common:
    """The views that are shown of every run.

    Attributes:
        names: in the order of the first run's capture; empty: there is nothing to show.
        longest: pixels of the longest side of a picture.
        held_out: whether no run has learned from any of them.
        apart: the runs, by number, whose capture is another one than the first run's.
        notes: what is to be known of it, for people.
    """

    names: tuple[str, ...]
    longest: int
    held_out: bool
    apart: frozenset[int]
    notes: tuple[str, ...]


def common_views(runs: Sequence[Contender], count: int, size: int) -> Common:
    """So many views that all runs can show, spread over those that all of them hold out.

    Where no view is held out by all, views that some run has learned from are shown, and a note says so.

    Args:
        runs: in the order of the columns.
        count: how many views; 0: none.
        size: pixels of the longest side of a picture; no run shows more than it was trained on.
    """
    first = runs[0]
    apart = frozenset(i for i, run in enumerate(runs) if not same_cameras(first.capture, run.capture))
    notes = [
        f"{runs[i].label} is of another capture ({runs[i].source.root}) than {first.label} "
        f"({first.source.root}): its figures are not to be compared, and no picture lays them side by side"
        for i in sorted(apart)
    ]
    together = [run for i, run in enumerate(runs) if i not in apart]
    notes += _other_photographs(together)
    if apart or count == 0:
        return Common((), size, False, apart, tuple(notes))
    shared = _shared([run.capture.views for run in runs])
    held_out = _shared([run.capture.test_views for run in runs])
    if not held_out:
        learners = [run.label for run in runs if not run.capture.test.issuperset(shared)]
        notes.append(
            f"no view is held out by every run, so {', '.join(learners)} learned from the views that are "
            "shown; train all with the same --test-every to compare new views"
        )
    return Common(
        names=evenly_spread(held_out or shared, count),
        longest=min(size, *(_trained_size(run.capture) for run in runs)),
        held_out=bool(held_out),
        apart=apart,
        notes=tuple(notes),
    )


def same_cameras(one: Capture, other: Capture) -> bool:
    """Whether two captures have views in common, by name, and the cameras of these agree up to their size."""
    beside = {view.name: view for view in other.views}
    pairs = [(view, beside[view.name]) for view in one.views if view.name in beside]
    units = 1 / one.normalisation.scale, 1 / other.normalisation.scale
    return bool(pairs) and all(_same_camera(a, b, units) for a, b in pairs)


def capture_to_show(capture: Capture, common: Common) -> Capture:
    """The capture with the common views held out, at the size of the pictures."""
    longest = max(max(file_size(view)) for view in capture.views)
    return replace(at_scale(capture, common.longest / longest), test=frozenset(common.names))


def _same_camera(one: View, other: View, units: tuple[float, float]) -> bool:
    a, b = one.camera, other.camera
    moved = np.abs((a.w2c - b.w2c)[:3] * np.array([1, 1, 1, min(units)])).max()
    zoomed = max(abs(a.fx / a.width - b.fx / b.width), abs(a.fy / a.height - b.fy / b.height))
    return bool(moved < POSE_TOLERANCE and zoomed < FIELD_TOLERANCE)


def _other_photographs(runs: Sequence[Contender]) -> list[str]:
    """A note on each run whose photographs have other contents than the first run's."""
    first = runs[0]
    files = {view.name: view.image for view in first.capture.views}
    return [
        f"{run.label} has other photographs ({run.source.root}) than {first.label} ({first.source.root}), "
        f"from the same cameras: where truths differ, those of {first.label} are shown"
        for run in runs[1:]
        if run.capture.root.resolve() != first.capture.root.resolve()
        and not all(
            filecmp.cmp(files[view.name], view.image, shallow=False)
            for view in run.capture.views
            if view.name in files
        )
    ]


def _shared(views: Sequence[Sequence[View]]) -> list[str]:
    """Names that are in every list, in the order of the first."""
    others = [{view.name for view in listed} for listed in views[1:]]
    return [view.name for view in views[0] if all(view.name in names for names in others)]


def _trained_size(capture: Capture) -> int:
    return max(max(view.camera.width, view.camera.height) for view in capture.views)
