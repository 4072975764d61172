"""`neilfpp prepare`: from a folder of photographs to a capture.

    merged ──► copies ──► matches ──► model ──► views ──► dense ──► capture

Each of these steps keeps its results in a folder of CAPTURE/work and is done once. The files of the capture
are written at the end, `capture.json` last: a folder without it is unfinished.
"""

from __future__ import annotations

import shlex
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import fields, replace
from pathlib import Path

from rich.console import Console

from neilfpp_method.data.bracket_folder import Brackets
from neilfpp_method.data.capture import READERS, Capture, load_capture, refuse_run
from neilfpp_method.data.formats.colmap import model_folder, open_model
from neilfpp_method.data.formats.copies import writing
from neilfpp_method.errors import Stopped, UserError
from neilfpp_method.prepare.background import sigterm_as_ctrl_c, silent
from neilfpp_method.prepare.layout import WORK, PoseSource, lay_out
from neilfpp_method.prepare.mapping import map_scene, refuse_partial
from neilfpp_method.prepare.matching import choose_pairing, extract_features, feature_counts, match_features
from neilfpp_method.prepare.matching_copies import write_copies
from neilfpp_method.prepare.merging import brackets_among, merge_photos
from neilfpp_method.prepare.options import Prepare
from neilfpp_method.prepare.photos import Photos, survey, unreadable
from neilfpp_method.prepare.posed import posed_by_capture, posed_by_model
from neilfpp_method.prepare.progress import Bars, bars
from neilfpp_method.prepare.sparse_cloud import sparse_points
from neilfpp_method.prepare.steps import begin, stamp
from neilfpp_method.prepare.summary import describe_cameras, placements, remarks_on

__all__ = ["run_prepare"]


def run_prepare(options: Prepare, console: Console) -> Path:
    """Make a capture from a folder of photographs and return the capture's folder.

    If the folder already holds a finished capture of the same images and options, nothing is done.

    Args:
        options: the options of the command.
        console: receives progress bars and the summary.

    Raises:
        UserError: the input is bad, or the images cannot be placed in one scene.
        Stopped: the command was interrupted; the message names the command that continues.
    """
    _check_place(options)
    silent()
    with _stop_with_command(options):
        return _prepare(options, console)


def _prepare(options: Prepare, console: Console) -> Path:
    posed = any(reader.recognize(options.images) for reader in READERS.values())
    capture = load_capture(options.images, response=options.response) if posed else None
    if not posed:
        refuse_run(options.images)
    photos = None if posed else survey(options.images, options.response)
    _check_readable(tuple(photos.unreadable.values()) if photos else (), options)
    brackets = photos and brackets_among(photos, options.brackets)
    with writing(options.out):
        with bars(console) as open_bar:
            source = (
                _from_capture(capture, options)
                if capture
                else _from_photos(photos, brackets, options, open_bar)
            )
            summary = lay_out(source, options, open_bar)
        if summary is None:
            console.print(f"{options.out}: already finished", highlight=False, soft_wrap=True)
            return options.out
        for line in summary.lines:
            console.print(line, highlight=False, soft_wrap=True)
        console.print(
            f"written to {options.out}; look at {options.out / 'summary.png'}",
            highlight=False,
            soft_wrap=True,
        )
    return options.out


def _check_place(options: Prepare) -> None:
    images, out = options.images.resolve(), options.out.resolve()
    if images.is_relative_to(out) or out.is_relative_to(images):
        raise UserError(
            f"{options.out}: one of the folders of images and capture lies inside the other",
            "choose another --out",
        )
    if out.exists() and not out.is_dir():
        raise UserError(f"{options.out}: not a folder", "choose another --out")
    if out.is_dir() and any(out.iterdir()) and not (out / WORK).is_dir():
        raise UserError(
            f"{options.out}: not empty, and not written by neilfpp prepare", "choose another --out"
        )
    if options.test_every is not None and (options.test_every < 0 or options.test_every == 1):
        raise UserError(
            f"every {options.test_every}-th view cannot be held out",
            "give 2 or more, or 0 to hold out no view",
        )


@contextmanager
def _stop_with_command(options: Prepare) -> Iterator[None]:
    """Turn Ctrl-C into `Stopped`, with the command that continues."""
    try:
        with sigterm_as_ctrl_c():
            yield
    except KeyboardInterrupt:
        arguments = [str(options.images), "--out", str(options.out)]
        for field in fields(options)[2:]:
            value = getattr(options, field.name)
            name = field.name.replace("_", "-")
            if isinstance(value, bool) and value != field.default:
                arguments.append(f"--{name}" if value else f"--no-{name}")
            elif value != field.default:
                arguments += [f"--{name}", *map(str, value if isinstance(value, tuple) else [value])]
        raise Stopped(
            "stopped; finished steps are kept", f"continue with: neilfpp prepare {shlex.join(arguments)}"
        ) from None


# ---------------------------------------------------------------------------------------------------- sources


def _check_readable(problems: tuple[str, ...], options: Prepare) -> None:
    if problems and not options.allow_partial:
        raise unreadable(problems)


def _from_capture(capture: Capture, options: Prepare) -> PoseSource:
    """The views of a capture with its own poses, and the points if it is a COLMAP model."""
    posed = posed_by_capture(capture)
    files = [path for view in posed.views for path in (view.image, view.mask, view.valid) if path]
    poses = [[view.name, view.camera.w2c.tolist(), view.camera.intrinsics.tolist()] for view in posed.views]
    step = begin(
        options.out / WORK / "poses", images=stamp(files, capture.root), poses=poses, linear=posed.linear
    )
    step.complete({})
    points = None
    if capture.format == "colmap":
        points = sparse_points(open_model(model_folder(capture.root)))
    return PoseSource(posed, step, points)


def _from_photos(photos: Photos, brackets: Brackets | None, options: Prepare, open_bar: Bars) -> PoseSource:
    """The photographs with poses from structure from motion, after the merging of exposure brackets."""
    work = options.out / WORK
    merged = merge_photos(photos, brackets, options.response, work / "merged", open_bar) if brackets else None
    photos = merged.photos if merged else photos
    files = stamp([photo.path for photo in photos.items], photos.root)
    step = begin(work / "copies", merged and merged.step, photos=files, linear=photos.linear)
    copies = step.folder
    if step.result is None:
        broken = write_copies(photos, copies, open_bar("copies for matching", len(photos.items)).advance)
        _check_readable(broken, options)
        step = replace(step, result=step.complete({"unreadable": broken}))
    problems = (*photos.unreadable.values(), *step.result["unreadable"])
    _check_readable(problems, options)
    photos = replace(photos, items=tuple(p for p in photos.items if (copies / f"{p.name}.png").is_file()))

    count = len(photos.items)
    pairing = choose_pairing(options.matching, count)
    step = begin(work / "matches", step, cameras=options.cameras, model=options.camera_model, pairing=pairing)
    database = step.folder / "database.db"
    if step.result is None:
        bar = open_bar("finding features", count)
        extract_features(database, copies, photos.items, options.cameras, options.camera_model, bar.to)
        match_features(database, pairing, step.folder, open_bar("matching pairs", 1).to)
        step = replace(step, result=step.complete({"features": feature_counts(database)}))
    features = step.result["features"]

    step = begin(work / "model", step)
    if step.result is None:
        mapped = map_scene(database, copies, step.folder, photos.items, open_bar("placing cameras", count).to)
        step = replace(step, result=step.complete({"sizes": mapped}))
    model = open_model(step.folder / "largest")
    placed = placements(features, model)
    sizes = tuple(step.result["sizes"])
    if not options.allow_partial:
        refuse_partial([p.name for p in placed if p.points is None], sizes)
    cameras = describe_cameras(model)
    remarks = [f"left out: {problem}" for problem in problems] + remarks_on(placed, sizes, cameras)
    remarks = (*([merged.remark] if merged else []), *remarks)
    return PoseSource(
        posed_by_model(photos, model), step, sparse_points(model), placed, sizes, cameras, remarks
    )
