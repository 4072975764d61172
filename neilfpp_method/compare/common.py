"""Select the views that all runs of a comparison can render, and describe how their captures differ."""

from __future__ import annotations

import filecmp
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from neilfpp_method.compare.runs import ComparedRun
from neilfpp_method.data.capture import Capture
from neilfpp_method.data.scaling import at_scale, file_size
from neilfpp_method.data.views import View
from neilfpp_method.evaluate.views import evenly_spread

__all__ = ["CommonViews", "capture_to_show", "common_views", "same_cameras"]

POSE_TOLERANCE = 0.05
"""Largest difference between two poses of the same view, in entries of the rotation and in scene units. A run
may have corrected the poses of its training views (`train.poses`), by up to about two degrees.
"""
FIELD_TOLERANCE = 1e-2
"""Largest difference between two focal lengths of the same view, as a fraction of the width of the image."""


@dataclass(frozen=True)
class CommonViews:
    """The views that are rendered of every run.

    Attributes:
        names: names of the views, in the order of the first run's capture; empty if none can be compared.
        longest: longest side of a view, pixels.
        held_out: whether all runs hold all of these views out of training.
        other_capture: indices of the runs whose capture differs from that of the first run.
        notes: remarks for the user.
    """

    names: tuple[str, ...]
    longest: int
    held_out: bool
    other_capture: frozenset[int]
    notes: tuple[str, ...]


def common_views(runs: Sequence[ComparedRun], count: int, size: int) -> CommonViews:
    """Select views that all runs can render, at even distances among those that all of them hold out.

    If no view is held out by all runs, views that some runs were trained on are selected, with a note.

    Args:
        runs: the runs in the order of the columns.
        count: number of views; 0 for none.
        size: longest side of a view, pixels. Views do not become larger than in the training of any run.
    """
    first = runs[0]
    other_capture = frozenset(i for i, run in enumerate(runs) if not same_cameras(first.capture, run.capture))
    notes = [
        f"{runs[i].label} was trained on another capture ({runs[i].source.root}) than {first.label} "
        f"({first.source.root}): its figures cannot be compared, and no image is written"
        for i in sorted(other_capture)
    ]
    same_capture = [run for i, run in enumerate(runs) if i not in other_capture]
    notes += _different_photographs(same_capture)
    if other_capture or count == 0:
        return CommonViews((), size, False, other_capture, tuple(notes))
    shared = _shared([run.capture.views for run in runs])
    held_out = _shared([run.capture.test_views for run in runs])
    if not held_out:
        trained = [run.label for run in runs if not run.capture.test.issuperset(shared)]
        notes.append(
            f"no view is held out by every run, so {', '.join(trained)} used the views shown here for "
            "training; train all runs with the same --test-every to compare new views"
        )
    return CommonViews(
        names=evenly_spread(held_out or shared, count),
        longest=min(size, *(_trained_size(run.capture) for run in runs)),
        held_out=bool(held_out),
        other_capture=other_capture,
        notes=tuple(notes),
    )


def same_cameras(one: Capture, other: Capture) -> bool:
    """Whether two captures share views, by name, whose cameras agree except for the size of the image."""
    by_name = {view.name: view for view in other.views}
    pairs = [(view, by_name[view.name]) for view in one.views if view.name in by_name]
    # In the larger of the two scenes, so that the result does not depend on the order.
    scale = max(one.normalization.scale, other.normalization.scale)
    return bool(pairs) and all(_same_camera(a, b, scale) for a, b in pairs)


def capture_to_show(capture: Capture, common: CommonViews) -> Capture:
    """Return the capture with the common views held out, at the size at which they are rendered."""
    longest = max(max(file_size(view)) for view in capture.views)
    return replace(at_scale(capture, common.longest / longest), test=frozenset(common.names))


def _same_camera(one: View, other: View, scale: float) -> bool:
    """Whether two cameras agree; `scale` is the length of a scene unit in the world frame."""
    a, b = one.camera, other.camera
    pose_difference = np.abs((a.w2c - b.w2c)[:3] * np.array([1, 1, 1, 1 / scale])).max()
    focal_difference = max(abs(a.fx / a.width - b.fx / b.width), abs(a.fy / a.height - b.fy / b.height))
    return bool(pose_difference < POSE_TOLERANCE and focal_difference < FIELD_TOLERANCE)


def _different_photographs(runs: Sequence[ComparedRun]) -> list[str]:
    """One note for each run whose photographs differ from those of the first run."""
    first = runs[0]
    files = {view.name: view.image for view in first.capture.views}
    return [
        f"{run.label} has different photographs ({run.source.root}) than {first.label} "
        f"({first.source.root}) from the same cameras: if the truth differs, that of {first.label} is shown"
        for run in runs[1:]
        if run.capture.root.resolve() != first.capture.root.resolve()
        and not all(
            filecmp.cmp(files[view.name], view.image, shallow=False)
            for view in run.capture.views
            if view.name in files
        )
    ]


def _shared(views: Sequence[Sequence[View]]) -> list[str]:
    """Names of the views that are in every list, in the order of the first."""
    others = [{view.name for view in view_list} for view_list in views[1:]]
    return [view.name for view in views[0] if all(view.name in names for names in others)]


def _trained_size(capture: Capture) -> int:
    return max(max(view.camera.width, view.camera.height) for view in capture.views)
