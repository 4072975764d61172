"""Images for display: maps in 8 bits, incident light in latitude-longitude projection, and contact sheets.

Pure functions on arrays. Metrics never read these images.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace

import cv2
import numpy as np
import torch
from jaxtyping import Bool, Float, Shaped, UInt8
from PIL import Image, ImageDraw, ImageFont
from scipy.spatial import cKDTree

from neilfpp_method.shading.color import luminance, tone_map

__all__ = [
    "Group",
    "PictureRow",
    "Section",
    "auto_exposure",
    "contact_sheet",
    "cut_out",
    "display",
    "display_color",
    "display_depth",
    "display_error",
    "lat_long_directions",
    "nearest_radiance",
    "ring",
]

PAPER = (250, 250, 248)
"""Background colour of a sheet, sRGB bytes."""
INK = (28, 30, 34)
"""Colour of titles."""
PALE_INK = (112, 116, 124)
"""Colour of notes and lines."""


# ------------------------------------------------------------------------------------------------------- maps


def display(name: str, values: Float[np.ndarray, "H W C"]) -> UInt8[np.ndarray, "H W C"]:
    """Convert a map to 8 bits, according to its name in `structures.Maps`.

    Normals become colours, depth is normalised to its 2nd and 98th percentile, other maps with one channel
    are grey, and colours are tone-mapped. Depths that are not finite belong to no surface: they are black and
    do not count in the range.
    """
    if name == "normal":
        return _to_bytes(0.5 * (values + 1.0))
    if name == "depth":
        finite = values[np.isfinite(values)]
        return display_depth(values, *(np.percentile(finite, [2, 98]) if finite.size else (0.0, 1.0)))
    return _to_bytes(values) if values.shape[-1] == 1 else display_color(values)


def display_color(radiance: Float[np.ndarray, "H W 3"], exposure: float = 1.0) -> UInt8[np.ndarray, "H W 3"]:
    """Multiply linear RGB by the exposure, clip to [0, 1] and encode as sRGB."""
    scaled = torch.from_numpy(np.asarray(radiance * exposure, dtype=np.float32))
    return _to_bytes(tone_map(scaled).numpy())


def display_depth(depth: Float[np.ndarray, "H W 1"], near: float, far: float) -> UInt8[np.ndarray, "H W 1"]:
    """Convert depth to grey, white at `near` and black at `far`; pixels without depth are black."""
    return _to_bytes((far - np.where(np.isfinite(depth), depth, far)) / max(far - near, 1e-6))


def display_error(error: Float[np.ndarray, "H W"], largest: float) -> UInt8[np.ndarray, "H W 3"]:
    """Convert errors to colours: black at 0, through red to pale yellow at `largest` and above."""
    return cv2.applyColorMap(_to_bytes(error / largest), cv2.COLORMAP_INFERNO)[..., ::-1]


def cut_out(
    picture: UInt8[np.ndarray, "H W C"],
    mask: Bool[np.ndarray, "H W"],
    background: tuple[int, int, int] = PAPER,
) -> UInt8[np.ndarray, "H W 3"]:
    """Replace the pixels outside of the mask by a background colour."""
    rgb = np.broadcast_to(picture, (*mask.shape, 3))
    return np.where(mask[..., None], rgb, np.array(background, dtype=np.uint8))


def _to_bytes(values: Float[np.ndarray, "*shape"]) -> UInt8[np.ndarray, "*shape"]:
    return np.rint(np.clip(np.nan_to_num(values), 0.0, 1.0) * 255.0).astype(np.uint8)


# --------------------------------------------------------------------------------------------- incident light


def lat_long_directions(height: int) -> Float[np.ndarray, "height W 3"]:
    """Unit directions of the pixels of a latitude-longitude image of width W = 2 · height.

    Row j has θ = π (j + ½)/height from +z and column i has φ = 2π (i + ½)/W; the direction is
    (sin φ sin θ, cos φ sin θ, cos θ).
    """
    theta = np.pi * (np.arange(height) + 0.5)[:, None] / height
    phi = np.pi * (np.arange(2 * height) + 0.5)[None] / height
    axes = (np.sin(phi) * np.sin(theta), np.cos(phi) * np.sin(theta), np.cos(theta) * np.ones_like(phi))
    return np.stack(axes, axis=-1).astype(np.float32)


def nearest_radiance(
    wi: Float[np.ndarray, "S 3"], radiance: Float[np.ndarray, "S 3"], directions: Float[np.ndarray, "H W 3"]
) -> Float[np.ndarray, "H W 3"]:
    """Look up radiance that is known along `wi` in other directions, by the nearest neighbour."""
    return radiance[cKDTree(wi).query(directions.reshape(-1, 3))[1]].reshape(directions.shape)


def ring(
    picture: UInt8[np.ndarray, "H W 3"],
    directions: Float[np.ndarray, "K 3"],
    color: tuple[int, int, int] = (255, 64, 64),
) -> UInt8[np.ndarray, "H W 3"]:
    """Draw rings around unit directions into a copy of a latitude-longitude image.

    Pixels correspond to directions as in `lat_long_directions`.
    """
    height, width, _ = picture.shape
    marked = np.ascontiguousarray(picture).copy()
    for x, y, z in directions:
        column = np.arctan2(x, y) / (2 * np.pi) % 1 * width
        row = np.arccos(np.clip(z, -1, 1)) / np.pi * height
        cv2.circle(marked, (int(column), int(row)), max(2, height // 20), color, 1, cv2.LINE_AA)
    return marked


def auto_exposure(radiance: Float[np.ndarray, "P 3"]) -> float:
    """The factor that scales the 90th percentile of luminance to 0.7; 1 if there is no radiance.

    Brighter values, such as those of lamps, may clip.
    """
    if not len(radiance):
        return 1.0
    level = np.percentile(luminance(torch.from_numpy(np.asarray(radiance, dtype=np.float32))).numpy(), 90)
    return 0.7 / max(float(level), 1e-6)


# ---------------------------------------------------------------------------------------------- contact sheet


@dataclass(frozen=True)
class Group:
    """Adjacent columns under a common title."""

    title: str
    columns: tuple[str, ...]


@dataclass(frozen=True)
class PictureRow:
    """One row of a section.

    Attributes:
        title: shown to the left of the row.
        pictures: one image per column; None leaves the cell empty.
        note: shown under the title.
        scale: the error at the bright end of the colour scale, with its unit; if given, a legend is drawn.
    """

    title: str
    pictures: tuple[UInt8[np.ndarray, "_ _ _"] | None, ...]
    note: str = ""
    scale: str = ""


@dataclass(frozen=True)
class Section:
    """Rows that have the same columns."""

    groups: tuple[Group, ...]
    rows: tuple[PictureRow, ...]


# Lengths of the layout, pixels.
MARGIN = 40
"""Width of the empty border of a sheet."""
GAP = 8
"""Distance between cells."""
GROUP_GAP = 28
"""Distance between groups of columns, and between sections."""
LABEL_WIDTH = 250
"""Width of the titles and notes to the left of the rows."""
TITLE_HEIGHT = 96
"""Height of the title and subtitle of a sheet."""
HEADER_HEIGHT = 70
"""Height of the column titles of a section."""
MIN_ROW_HEIGHT = 100
"""Least height of a row, so that its title, note and legend fit."""
TITLE, HEADING, TEXT, NOTE = 34, 24, 20, 16
"""Font sizes: titles of sheets, titles of groups, titles of rows, notes."""


def contact_sheet(
    title: str, subtitle: str, sections: Sequence[Section], cell_width: int = 240
) -> UInt8[np.ndarray, "H W 3"]:
    """Draw sections below one another. Every image is scaled to the width of a cell; aspect ratios are kept.

    If `title` is empty, no space is reserved for title and subtitle.
    """
    fitted = [_fit_section(section, cell_width) for section in sections]
    width = LABEL_WIDTH + max(_columns_width(s.groups, cell_width) for s in sections) + 2 * MARGIN
    title_height = TITLE_HEIGHT if title else 0
    height = 2 * MARGIN - GROUP_GAP + title_height + sum(_section_height(section) for section in fitted)
    sheet = Image.new("RGB", (width, height), PAPER)
    draw = ImageDraw.Draw(sheet)
    _write(draw, (MARGIN, MARGIN), title, TITLE)
    _write(draw, (MARGIN, MARGIN + 46), subtitle, TEXT, PALE_INK)
    top = MARGIN + title_height
    for section in fitted:
        _draw_section(sheet, draw, section, top, cell_width)
        top += _section_height(section)
    return np.asarray(sheet)


def _draw_section(
    sheet: Image.Image, draw: ImageDraw.ImageDraw, section: Section, top: int, cell_width: int
) -> None:
    lefts = list(_column_lefts(section.groups, cell_width))
    column = 0
    for group in section.groups:
        left, right = lefts[column], lefts[column + len(group.columns) - 1] + cell_width
        _write(draw, (left, top), group.title, HEADING)
        draw.line([(left, top + 34), (right, top + 34)], fill=PALE_INK, width=1)
        for name in group.columns:
            _write(draw, (lefts[column], top + 42), name, NOTE, PALE_INK)
            column += 1
    top += HEADER_HEIGHT
    for row in section.rows:
        _write(draw, (MARGIN, top), row.title, TEXT)
        _write(draw, (MARGIN, top + 28), row.note, NOTE, PALE_INK)
        if row.scale:
            _draw_legend(sheet, draw, (MARGIN, top + 34 + 20 * len(row.note.splitlines())), row.scale)
        for left, picture in zip(lefts, row.pictures, strict=True):
            if picture is not None:
                sheet.paste(Image.fromarray(picture), (left, top))
        top += _row_height(row) + GAP


def _draw_legend(sheet: Image.Image, draw: ImageDraw.ImageDraw, corner: tuple[int, int], scale: str) -> None:
    left, top = corner
    ramp = np.broadcast_to(np.linspace(0.0, 1.0, 110), (10, 110))
    _write(draw, (left, top), "error  0", NOTE, PALE_INK)
    sheet.paste(Image.fromarray(display_error(ramp, 1.0)), (left + 64, top + 5))
    _write(draw, (left + 182, top), scale, NOTE, PALE_INK)


def _section_height(section: Section) -> int:
    return HEADER_HEIGHT + sum(_row_height(row) + GAP for row in section.rows) + GROUP_GAP


def _row_height(row: PictureRow) -> int:
    return max([MIN_ROW_HEIGHT] + [picture.shape[0] for picture in row.pictures if picture is not None])


def _column_lefts(groups: Sequence[Group], cell_width: int) -> Iterator[int]:
    left = MARGIN + LABEL_WIDTH
    for group in groups:
        for _ in group.columns:
            yield left
            left += cell_width + GAP
        left += GROUP_GAP - GAP


def _columns_width(groups: Sequence[Group], cell_width: int) -> int:
    return max(_column_lefts(groups, cell_width)) + cell_width - MARGIN - LABEL_WIDTH


def _fit_section(section: Section, cell_width: int) -> Section:
    rows = (
        replace(row, pictures=tuple(_fit(picture, cell_width) for picture in row.pictures))
        for row in section.rows
    )
    return replace(section, rows=tuple(rows))


def _fit(picture: Shaped[np.ndarray, "H W C"] | None, width: int) -> UInt8[np.ndarray, "h w 3"] | None:
    if picture is None:
        return None
    height = max(round(picture.shape[0] * width / picture.shape[1]), 1)
    method = cv2.INTER_AREA if picture.shape[1] > width else cv2.INTER_CUBIC
    scaled = cv2.resize(np.ascontiguousarray(picture), (width, height), interpolation=method)
    return np.ascontiguousarray(np.broadcast_to(scaled.reshape(height, width, -1), (height, width, 3)))


def _write(
    draw: ImageDraw.ImageDraw,
    corner: tuple[int, int],
    text: str,
    size: int,
    color: tuple[int, int, int] = INK,
) -> None:
    draw.multiline_text(corner, text, font=ImageFont.load_default(size), fill=color, spacing=4)
