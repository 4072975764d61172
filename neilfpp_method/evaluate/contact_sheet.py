"""Contact sheets: pictures in rows and columns, with titles and notes."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace

import cv2
import numpy as np
from jaxtyping import Shaped, UInt8
from PIL import Image, ImageDraw

from neilfpp_method.drawing.ink import PALE_INK, PAPER, write
from neilfpp_method.evaluate.pictures import display_error

__all__ = ["Group", "PictureRow", "Section", "contact_sheet"]


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
    write(draw, (MARGIN, MARGIN), title, TITLE)
    write(draw, (MARGIN, MARGIN + 46), subtitle, TEXT, PALE_INK)
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
        write(draw, (left, top), group.title, HEADING)
        draw.line([(left, top + 34), (right, top + 34)], fill=PALE_INK, width=1)
        for name in group.columns:
            write(draw, (lefts[column], top + 42), name, NOTE, PALE_INK)
            column += 1
    top += HEADER_HEIGHT
    for row in section.rows:
        write(draw, (MARGIN, top), row.title, TEXT)
        write(draw, (MARGIN, top + 28), row.note, NOTE, PALE_INK)
        if row.scale:
            _draw_legend(sheet, draw, (MARGIN, top + 34 + 20 * len(row.note.splitlines())), row.scale)
        for left, picture in zip(lefts, row.pictures, strict=True):
            if picture is not None:
                sheet.paste(Image.fromarray(picture), (left, top))
        top += _row_height(row) + GAP


def _draw_legend(sheet: Image.Image, draw: ImageDraw.ImageDraw, corner: tuple[int, int], scale: str) -> None:
    left, top = corner
    ramp = np.broadcast_to(np.linspace(0.0, 1.0, 110), (10, 110))
    write(draw, (left, top), "error  0", NOTE, PALE_INK)
    sheet.paste(Image.fromarray(display_error(ramp, 1.0)), (left + 64, top + 5))
    write(draw, (left + 182, top), scale, NOTE, PALE_INK)


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
