"""Run `neilfpp inspect`: print the defects, and write them as JSON and as a picture."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any, Literal

from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn
from rich.text import Text

from neilfpp_method.data.capture import load_capture
from neilfpp_method.data.files.atomic_file import replacing
from neilfpp_method.data.files.images import write_png
from neilfpp_method.data.pixels.object_source import object_line
from neilfpp_method.data.views import View
from neilfpp_method.errors import EarlyEnd
from neilfpp_method.inspection.defects import Inspection, inspect_capture
from neilfpp_method.inspection.measure import ViewFigures
from neilfpp_method.inspection.picture import draw

__all__ = ["run_inspection", "to_json"]

STYLES = {
    "problem": "bold red",
    "warning": "yellow",
    "good": "bold green",
    "limited": "bold yellow",
    "poor": "bold red",
}
"""Style of a word on the console: the severity of a defect, or the level of the radiance."""


def run_inspection(
    root: Path,
    out: Path | None,
    format: str | None,
    response: Literal["auto", "linear", "srgb"],
    strict: bool,
    console: Console,
) -> None:
    """Inspect a capture and print a report.

    Args:
        root: the folder of the capture.
        out: folder for `inspect.json` and `inspect.png`; None: they are not written.
        format: the layout of the capture; None: it is detected.
        response: meaning of the pixel values; "auto": as the files state.
        strict: whether to end with status 1 if there is a problem.
        console: the console for the report.

    Raises:
        UserError: the folder has no capture that can be loaded.
        EarlyEnd: `strict` is set, and there is a problem.
    """
    capture = load_capture(root, format=format, response=response)
    columns = (TextColumn("reading images"), BarColumn(), MofNCompleteColumn())
    with Progress(*columns, console=console, transient=True, disable=not console.is_terminal) as progress:
        task = progress.add_task("", total=len(capture.views))
        inspection = inspect_capture(capture, lambda _: progress.advance(task))
    _print(inspection, console)
    if out is not None:
        with replacing(out / "inspect.json") as temporary:
            temporary.write_text(json.dumps(to_json(inspection), indent=2, allow_nan=False) + "\n", "utf-8")
        write_png(out / "inspect.png", draw(inspection))
        console.print(f"written to {out}", highlight=False)
    problems = sum(defect.severity == "problem" for defect in inspection.defects)
    if strict and problems:
        raise EarlyEnd(
            f"{root}: {problems} problem{'s' * (problems != 1)}",
            "see the remedies above",
        )


FIGURES = ("luminance", "stops", "sharpness", "clipped", "invalid", "broken", "pixels", "levels")
"""Attributes of `ViewFigures` that `inspect.json` has for each view."""


def to_json(inspection: Inspection) -> dict[str, Any]:
    """Return the inspection as plain values, the content of `inspect.json`."""
    each = zip(inspection.capture.views, inspection.views, inspection.factors, strict=True)
    return {
        "capture": _of_capture(inspection),
        "radiance": {"level": inspection.radiance.level, "text": inspection.radiance.text},
        "defects": [
            {
                "kind": defect.kind,
                "severity": defect.severity,
                "text": defect.text,
                "remedy": defect.remedy,
                "views": list(defect.views),
            }
            for defect in inspection.defects
        ],
        "views": [_of_view(inspection.capture.root, *one) for one in each],
    }


def _of_capture(inspection: Inspection) -> dict[str, Any]:
    capture, placement = inspection.capture, inspection.placement
    return {
        "name": capture.root.resolve().name,
        "format": capture.format,
        "response": "linear" if capture.hdr else "srgb",
        "views": len(capture.views),
        "test_views": len(capture.test_views),
        "missing_images": list(capture.missing),
        "masks": sum(view.mask is not None for view in capture.views),
        "validity_masks": sum(view.valid is not None for view in capture.views),
        "point_cloud": capture.point_cloud is not None,
        "scene": {"centre": list(capture.normalization.center), "radius": capture.normalization.scale},
        "scene_from": capture.scene_from,
        "coverage": placement.coverage,
        "degrees_between_views": placement.gap,
    }


def _of_view(root: Path, view: View, measured: ViewFigures, factor: float) -> dict[str, Any]:
    return {
        "name": view.name,
        "image": view.image.resolve().relative_to(root.resolve()).as_posix(),
        "width": view.camera.width,
        "height": view.camera.height,
        "exposure": view.exposure,
        "exposure_factor": factor,
        "object_from": measured.object_from,
        **{name: getattr(measured, name) for name in FIGURES},
    }


def _print(inspection: Inspection, console: Console) -> None:
    def say(*parts: str | tuple[str, str]) -> None:
        console.print(Text.assemble(*parts), soft_wrap=True)

    placement, radiance = inspection.placement, inspection.radiance
    say(inspection.capture.summary)
    say(object_line([view.object_from for view in inspection.views if not view.unreadable]))
    say(
        f"cameras: a median angle of {placement.gap:.0f}° to the nearest camera; they cover "
        f"{100 * placement.coverage:.0f} % of all directions"
    )
    say("radiance: ", (radiance.level, STYLES[radiance.level]), f"; {radiance.text}")
    if not inspection.defects:
        say(("no problems found", STYLES["good"]))
    for defect in inspection.defects:
        say((defect.severity, STYLES[defect.severity]), f": {defect.line()}")
