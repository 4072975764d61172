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

from neilfpp_method.data.brackets.folder import Brackets
from neilfpp_method.data.capture import READERS, Capture, load_capture, refuse_run
from neilfpp_method.data.formats.colmap import model_folder, open_model
from neilfpp_method.data.formats.copies import writing
from neilfpp_method.data.split import check_test_every
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
from neilfpp_method.prepare.steps import Step, begin, stamp
from neilfpp_method.prepare.summary import describe_cameras, placements, remarks_on

__all__ = ["run_prepare"]

DATABASE = "database.db"
"""COLMAP's database of features and matches, in the folder of the step that matches."""


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
    check_test_every(options.test_every)
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


@contextmanager
def _stop_with_command(options: Prepare) -> Iterator[None]:
    """Turn Ctrl-C into `Stopped`, with the command that continues."""
    try:
        with sigterm_as_ctrl_c():
            yield
    except KeyboardInterrupt:
        raise Stopped(
            "stopped; finished steps are kept", f"continue with: {_command_line(options)}"
        ) from None


def _command_line(options: Prepare) -> str:
    """The command with these options, without those that have their default."""
    words = ["neilfpp", "prepare", str(options.images)]
    for field in fields(options):
        value, name = getattr(options, field.name), field.name.replace("_", "-")
        if field.name == "images" or value == field.default:
            continue
        if isinstance(value, bool):
            words.append(f"--{name}" if value else f"--no-{name}")
        else:
            words += [f"--{name}", *map(str, value if isinstance(value, tuple) else [value])]
    return shlex.join(words)


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
    return PoseSource(posed, step, points, remarks=capture.remarks)


def _from_photos(photos: Photos, brackets: Brackets | None, options: Prepare, open_bar: Bars) -> PoseSource:
    """The photographs with poses from structure from motion, after the merging of exposure brackets."""
    work = options.out / WORK
    merged = merge_photos(photos, brackets, options.response, work / "merged", open_bar) if brackets else None
    photos = merged.photos if merged else photos
    copied = _copy(photos, merged and merged.step, options, open_bar)
    problems = (*photos.unreadable.values(), *copied.result["unreadable"])
    _check_readable(problems, options)
    readable = tuple(photo for photo in photos.items if (copied.folder / f"{photo.name}.png").is_file())
    photos = replace(photos, items=readable)
    matched = _match(photos, copied, options, open_bar)
    mapped = _map(photos, copied, matched, options, open_bar)

    model = open_model(mapped.folder / "largest")
    placed = placements(matched.result["features"], model)
    sizes = tuple(mapped.result["sizes"])
    if not options.allow_partial:
        refuse_partial([p.name for p in placed if p.points is None], sizes)
    cameras = describe_cameras(model)
    remarks = (
        *([merged.remark] if merged else []),
        *(f"left out: {problem}" for problem in problems),
        *remarks_on(placed, sizes, cameras),
    )
    return PoseSource(
        posed_by_model(photos, model), mapped, sparse_points(model), placed, sizes, cameras, remarks
    )


def _copy(photos: Photos, after: Step | None, options: Prepare, open_bar: Bars) -> Step:
    """The step that writes 8-bit copies for matching; its result names the photographs without one."""
    files = stamp([photo.path for photo in photos.items], photos.root)
    step = begin(options.out / WORK / "copies", after, photos=files, linear=photos.linear)
    if step.result is not None:
        return step
    broken = write_copies(photos, step.folder, open_bar("copies for matching", len(photos.items)).advance)
    # The step stays open if the command ends here, so that repaired photographs are copied the next time.
    _check_readable(broken, options)
    return step.complete({"unreadable": broken})


def _match(photos: Photos, copied: Step, options: Prepare, open_bar: Bars) -> Step:
    """The step that finds and matches features; its result has the number of features of each photograph."""
    count = len(photos.items)
    pairing = choose_pairing(options.matching, count)
    step = begin(
        options.out / WORK / "matches",
        copied,
        cameras=options.cameras,
        model=options.camera_model,
        pairing=pairing,
    )
    if step.result is not None:
        return step
    database = step.folder / DATABASE
    bar = open_bar("finding features", count)
    extract_features(database, copied.folder, photos.items, options.cameras, options.camera_model, bar.to)
    match_features(database, pairing, step.folder, open_bar("matching pairs", 1).to)
    return step.complete({"features": feature_counts(database)})


def _map(photos: Photos, copied: Step, matched: Step, options: Prepare, open_bar: Bars) -> Step:
    """The step that estimates poses and points; its result has the number of images of each model."""
    step = begin(options.out / WORK / "model", matched)
    if step.result is not None:
        return step
    progress = open_bar("placing cameras", len(photos.items)).to
    database = matched.folder / DATABASE
    return step.complete({"sizes": map_scene(database, copied.folder, step.folder, photos.items, progress)})
