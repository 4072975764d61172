"""Draw the picture of an inspection: the camera positions, and all views, flagged ones first."""

from __future__ import annotations

import numpy as np
import torch
from jaxtyping import Float, Float64, UInt8
from PIL import Image, ImageDraw

from neilfpp_method.drawing.ink import PALE_INK, PAPER, Color, write
from neilfpp_method.inspection.defects import Inspection
from neilfpp_method.shading.color import tone_map

__all__ = ["draw"]

PROBLEM, WARNING, FINE = (200, 40, 40), (225, 150, 20), (70, 130, 180)
"""Frame colours of views with a problem, with a warning, and without defects."""
SEVEREST_FIRST = (PROBLEM, WARNING, FINE)
"""Order in which views are drawn, by the colour of their frame."""
CELL, LABEL, GAP, MARGIN = 160, 40, 12, 32
"""Side of a view, height of its label, space between views, and margin of the sheet, in pixels."""
COLUMNS = 7
"""Number of views in a row."""
PLAN_SIDE = 420
"""Side of each plot of the camera positions, in pixels."""
MAX_DRAWN = 210
"""Largest number of views in the picture."""
DISPLAYED_MEDIAN = 0.25
"""Linear value to which the median luminance of the capture is scaled for display."""


def draw(inspection: Inspection) -> UInt8[np.ndarray, "H W 3"]:
    """Draw the picture. All views have the same exposure, so that differences are visible."""
    colors = _colors(inspection)
    order = sorted(range(len(colors)), key=lambda i: SEVEREST_FIRST.index(colors[i]))[:MAX_DRAWN]
    rows = -(-len(order) // COLUMNS)
    width = 2 * MARGIN + COLUMNS * (CELL + GAP) - GAP
    top = MARGIN + 70 + PLAN_SIDE + 2 * GAP
    sheet = Image.new("RGB", (width, top + rows * (CELL + LABEL + GAP) + MARGIN), PAPER)
    pen = ImageDraw.Draw(sheet)
    radiance, capture = inspection.radiance, inspection.capture
    write(pen, (MARGIN, MARGIN - 6), f"{capture.root.resolve().name}: {len(capture.views)} views", 26)
    write(pen, (MARGIN, MARGIN + 32), f"radiance {radiance.level}: {radiance.text}", 16, PALE_INK)
    for k, (axes, title) in enumerate([((0, 1), "along z (x, y)"), ((0, 2), "along y (x, z)")]):
        plan = Image.fromarray(_plan(inspection, axes, colors, title))
        sheet.paste(plan, (MARGIN + k * (PLAN_SIDE + 2 * GAP), MARGIN + 70))
    _list(pen, (MARGIN + 2 * (PLAN_SIDE + 2 * GAP), MARGIN + 78), inspection)
    exposure = DISPLAYED_MEDIAN / float(
        np.median([v.luminance for v in inspection.views if v.luminance > 0] or [1.0])
    )
    for place, i in enumerate(order):
        corner = (MARGIN + place % COLUMNS * (CELL + GAP), top + place // COLUMNS * (CELL + LABEL + GAP))
        view = inspection.views[i]
        picture = Image.fromarray(_shown(view.small, exposure))
        kinds = [d.kind.replace("_", " ") for d in inspection.defects if view.name in d.views]
        _cell(sheet, pen, corner, picture, colors[i])
        write(pen, (corner[0], corner[1] + CELL + 4), view.name[:22], 14)
        write(pen, (corner[0], corner[1] + CELL + 21), ", ".join(kinds)[:26], 12, colors[i])
    return np.asarray(sheet)


def _colors(inspection: Inspection) -> list[Color]:
    problems = {
        name for defect in inspection.defects if defect.severity == "problem" for name in defect.views
    }
    warnings = {name for defect in inspection.defects for name in defect.views}
    return [
        PROBLEM if v.name in problems else WARNING if v.name in warnings else FINE for v in inspection.views
    ]


def _plan(
    inspection: Inspection, axes: tuple[int, int], colors: list[Color], title: str
) -> UInt8[np.ndarray, "_ _ 3"]:
    """Plot cameras as dots with viewing directions, projected along a world axis, with the unit sphere."""
    plan = Image.new("RGB", (PLAN_SIDE, PLAN_SIDE), (255, 255, 255))
    pen = ImageDraw.Draw(plan)
    centers, forward = inspection.placement.centers[:, axes], inspection.placement.axes[:, axes]
    reach = 1.15 * max(1.0, float(np.abs(centers).max()))

    def place(points: Float64[np.ndarray, "*N 2"]) -> Float64[np.ndarray, "*N 2"]:
        return PLAN_SIDE / 2 * (1 + points / reach * np.array([1, -1]))

    pen.ellipse([*place(np.array([-1.0, 1.0])), *place(np.array([1.0, -1.0]))], outline=PALE_INK)
    for start, end, color in zip(
        place(centers), place(centers + 0.12 * reach * forward), colors, strict=True
    ):
        pen.line([*start, *end], fill=color, width=2)
        pen.ellipse([*(start - 4), *(start + 4)], fill=color)
    write(pen, (10, 8), title, 14, PALE_INK)
    return np.asarray(plan)


def _list(pen: ImageDraw.ImageDraw, corner: tuple[int, int], inspection: Inspection) -> None:
    for place, defect in enumerate(inspection.defects):
        count = f": {len(defect.views)} view{'s' * (len(defect.views) != 1)}" if defect.views else ""
        color = PROBLEM if defect.severity == "problem" else WARNING
        write(pen, (corner[0], corner[1] + 26 * place), defect.kind.replace("_", " ") + count, 16, color)
    if not inspection.defects:
        write(pen, corner, "no problems found", 16, FINE)


def _cell(
    sheet: Image.Image,
    pen: ImageDraw.ImageDraw,
    corner: tuple[int, int],
    picture: Image.Image,
    color: Color,
) -> None:
    """Draw a view in a frame of the given colour."""
    picture.thumbnail((CELL, CELL))
    sheet.paste(picture, (corner[0] + (CELL - picture.width) // 2, corner[1] + (CELL - picture.height) // 2))
    pen.rectangle(
        [corner[0] - 3, corner[1] - 3, corner[0] + CELL + 2, corner[1] + CELL + 2], outline=color, width=3
    )


def _shown(radiance: Float[np.ndarray, "h w 3"], exposure: float) -> UInt8[np.ndarray, "h w 3"]:
    return (tone_map(torch.from_numpy(radiance * np.float32(exposure))).numpy() * 255 + 0.5).astype(np.uint8)
