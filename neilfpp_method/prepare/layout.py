"""The last steps of `neilfpp prepare`: from posed views to the folder of the capture.

The files are copied into that folder when all steps are done, `capture.json` last, so that an unfinished
folder is never mistaken for a capture.
"""

from __future__ import annotations

import shutil
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from neilfpp_method.data.capture import Capture, load_capture
from neilfpp_method.data.capture_folder import FILE, recognize, write_capture
from neilfpp_method.data.formats.copies import copy_file
from neilfpp_method.data.formats.write_sfm_scene import write_sfm_scene
from neilfpp_method.data.formats.write_transforms import write_transforms
from neilfpp_method.data.point_cloud import WorldPoints, read_oriented_ply, write_oriented_ply
from neilfpp_method.data.scene_box import SceneBox, find_box
from neilfpp_method.data.split import every_kth
from neilfpp_method.data.views import CaptureFiles, View
from neilfpp_method.errors import UserError
from neilfpp_method.inspection.defects import MIN_COUNT, inspect_capture, problems, views_to_leave_out
from neilfpp_method.prepare.dense_cloud import dense_cloud
from neilfpp_method.prepare.options import Prepare
from neilfpp_method.prepare.pictures import write_picture
from neilfpp_method.prepare.posed import Posed, write_views
from neilfpp_method.prepare.progress import Bars
from neilfpp_method.prepare.sparse_cloud import SparsePoints, oriented, reliable, without_outliers
from neilfpp_method.prepare.steps import Step, begin
from neilfpp_method.prepare.summary import Placement, Summary, write_summary

__all__ = ["WORK", "PoseSource", "lay_out"]

WORK = "work"
"""Folder inside the capture's folder in which the steps keep their results."""

CLOUD = "points.ply"
"""File of the oriented point cloud."""

IMAGE_FOLDERS = ("images", "masks", "valid")
"""Folders of a capture that this module writes, and empties first."""

WRITERS = {"nerfstudio": write_transforms, "neilf": write_sfm_scene}
"""Writers of other layouts, by the value of `--also`."""


@dataclass(frozen=True)
class PoseSource:
    """Posed views from which a capture is made, and where the poses come from.

    Attributes:
        posed: the views.
        step: the step that found the poses.
        points: sparse points of structure from motion; None if the poses came without points.
        placed: how well each image fits the model; empty if the poses came with the images.
        models: number of images of each model that structure from motion made, largest first.
        cameras: the estimated cameras, as in `describe_cameras`.
        remarks: notes for the summary.
    """

    posed: Posed
    step: Step
    points: SparsePoints | None
    placed: tuple[Placement, ...] = ()
    models: tuple[int, ...] = ()
    cameras: tuple[dict, ...] = ()
    remarks: tuple[str, ...] = ()


@dataclass(frozen=True)
class _Cloud:
    """The oriented points of a capture, possibly none, and a description of their source for the summary."""

    points: WorldPoints
    source: str


def lay_out(source: PoseSource, options: Prepare, open_bar: Bars) -> Summary | None:
    """Write the folder of the capture with its summary.

    Returns:
        The summary; None if the folder already holds the capture of the same source and options.

    Raises:
        UserError: an image cannot be read, or the extent of the scene cannot be determined.
    """
    work = options.out / WORK
    step = begin(work / "views", source.step, undistort=options.undistort)
    last = begin(
        work / "capture",
        step,
        test_every=options.test_every,
        cloud=options.cloud,
        also=options.also,
        auto=options.auto,
    )
    if last.result is not None and recognize(options.out):
        return None
    if step.result is None:
        _write_posed_views(source, options, step, open_bar)
    prepared = load_capture(step.folder)
    bar = open_bar("inspecting", len(prepared.views))
    inspection = inspect_capture(prepared, lambda _: bar.advance())
    rejected = views_to_leave_out(inspection) if options.auto else {}
    kept = tuple(view for view in prepared.views if view.name not in rejected)
    if len(kept) < MIN_COUNT and rejected:
        named = ", ".join(rejected)
        remarks = [f"no view is left out: fewer than {MIN_COUNT} would remain without {named}"]
    else:
        remarks = [f"left out: {name}, {reason}" for name, reason in rejected.items()]
        prepared = replace(prepared, views=kept)
        inspection = inspect_capture(prepared) if rejected else inspection
    source = replace(source, remarks=(*source.remarks, *remarks))
    cloud = _cloud(source, prepared, options, step, open_bar)
    if prepared.scene_from == "cameras" and len(cloud.points.position):
        box = find_box(prepared.views, cloud.points.position)
        prepared = replace(prepared, normalization=box.normalization, scene_from=box.source)
    summary = _publish(source, prepared, cloud, problems(inspection), options)
    last.complete({})
    return summary


def _write_posed_views(source: PoseSource, options: Prepare, step: Step, open_bar: Bars) -> None:
    """Write the views with their scene box as a capture in the folder of a step, and complete the step."""
    posed, points = source.posed, None
    if source.points is not None and len(source.points):
        points = source.points.position[reliable(source.points)]
    bar = open_bar("writing images", len(posed.views))
    views = write_views(posed, step.folder, options.undistort, bar.advance)
    if posed.normalization:
        box = SceneBox(posed.normalization, posed.scene_from)
    else:
        box = find_box(views, points)
    files = CaptureFiles(step.folder, views, box.normalization, scene_from=box.source)
    write_capture(step.folder, files, response="linear" if posed.linear else "srgb")
    step.complete({})


def _cloud(source: PoseSource, prepared: Capture, options: Prepare, after: Step, open_bar: Bars) -> _Cloud:
    """The oriented points of the capture, from the best source that the options allow."""
    if options.cloud == "dense" or (options.cloud == "auto" and source.posed.cloud is None):
        try:
            return _Cloud(_dense(prepared, options, after, open_bar), "dense: plane-sweep stereo")
        except UserError as error:
            if options.cloud == "dense":
                raise
            no_dense = f"; no dense points, because {error.problem}"
    else:
        no_dense = ""
    if source.posed.cloud is not None:
        points = without_outliers(read_oriented_ply(source.posed.cloud))
        return _Cloud(points, "given with the capture")
    if source.points is not None:
        return _Cloud(oriented(source.points), f"sparse: structure from motion{no_dense}")
    nothing = WorldPoints(np.empty((0, 3)), np.empty((0, 3)))
    return _Cloud(nothing, f"none: the poses came without points that have normals{no_dense}")


def _dense(prepared: Capture, options: Prepare, after: Step, open_bar: Bars) -> WorldPoints:
    """The dense cloud; it is computed once and read again when the command is repeated."""
    step = begin(options.out / WORK / "dense", after, views=[view.name for view in prepared.views])
    path = step.folder / CLOUD
    if step.result is None:
        write_oriented_ply(path, dense_cloud(prepared, step.folder, open_bar))
        step.complete({})
    return read_oriented_ply(path)


def _publish(
    source: PoseSource, prepared: Capture, cloud: _Cloud, problems: tuple[str, ...], options: Prepare
) -> Summary:
    """Write the folder of the capture; `capture.json` is removed first and written last."""
    out = options.out
    (out / FILE).unlink(missing_ok=True)
    for name in IMAGE_FOLDERS:
        shutil.rmtree(out / name, ignore_errors=True)
    for path in (path for view in prepared.views for path in (view.image, view.mask, view.valid) if path):
        copy_file(path, out / path.relative_to(prepared.root))
    count = len(cloud.points.position)
    points = write_oriented_ply(out / CLOUD, cloud.points) if count else None
    views = tuple(_relocate(view, prepared.root, out) for view in prepared.views)
    test = _test_views(source.posed, views, options.test_every)
    box = prepared.normalization
    summary = Summary(
        placements=source.placed,
        models=source.models,
        cameras=source.cameras,
        views=len(views),
        points=count,
        cloud=cloud.source,
        radius=box.scale,
        scene_from=prepared.scene_from,
        remarks=source.remarks,
        problems=problems,
    )
    write_summary(out / "summary.json", summary)
    write_picture(out / "summary.png", views, test, cloud.points, box, source.placed)
    files = CaptureFiles(out, views, box, points, scene_from=prepared.scene_from)
    write_capture(out, files, response="linear" if prepared.hdr else "srgb", test=test)
    for name in options.also:
        WRITERS[name](load_capture(out, format="neilfpp"), out / name)
    return summary


def _relocate(view: View, old: Path, new: Path) -> View:
    """The view with its files in the folder `new` in place of `old`."""

    def relocated(path: Path | None) -> Path | None:
        return path and new / path.relative_to(old)

    return replace(view, image=relocated(view.image), mask=relocated(view.mask), valid=relocated(view.valid))


def _test_views(posed: Posed, views: tuple[View, ...], test_every: int | None) -> frozenset[str]:
    if test_every is None and posed.test is not None:
        # A test view of the capture may have been left out.
        return posed.test & {view.name for view in views}
    return every_kth(views, test_every)
