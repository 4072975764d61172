"""The image of a comparison: one section per view, columns for the truth and each run, one row per map."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import UInt8

from neilfpp_method.evaluate.contact_sheet import Group, PictureRow, Section, contact_sheet
from neilfpp_method.evaluate.panels import ComparedMap
from neilfpp_method.report.measured import count_of_views
from neilfpp_method.report.views import title_of

__all__ = ["Column", "comparison_sheet", "shortened"]

MAX_LABEL = 27
"""Number of characters that fit above an image of a sheet."""


@dataclass(frozen=True)
class Column:
    """The maps of one run; each has a comparison for every view."""

    label: str
    maps: tuple[ComparedMap, ...]


def comparison_sheet(
    title: str, views: Sequence[str], columns: Sequence[Column]
) -> UInt8[np.ndarray, "H W 3"]:
    """Draw the sheet. A cell is empty if the run does not have the map, or its truth is not known.

    Args:
        title: title of the sheet.
        views: names of the views, in the order of the comparisons of every map.
        columns: the runs from left to right. The truth of a map is taken from the first run that has it.
    """
    titles = list(dict.fromkeys(title_of(m) for column in columns for m in column.maps))
    by_title = [{title_of(m): m for m in column.maps} for column in columns]
    headings = ("truth", *(shortened(column.label) for column in columns))
    sections = []
    for i, view in enumerate(views):
        rows = tuple(_row(name, [maps.get(name) for maps in by_title], i) for name in titles)
        sections.append(Section((Group(f"View {view}", headings),), rows))
    return contact_sheet(title, f"{count_of_views(len(views))} of {len(columns)} runs", sections)


def shortened(label: str) -> str:
    """Shorten a label to `MAX_LABEL` characters by removing its middle."""
    if len(label) <= MAX_LABEL:
        return label
    end = MAX_LABEL // 2
    return f"{label[: MAX_LABEL - end - 1]}…{label[-end:]}"


def _row(title: str, maps: Sequence[ComparedMap | None], view: int) -> PictureRow:
    comparisons = [None if m is None else m.comparisons[view] for m in maps]
    truth = next((c.truth for c in comparisons if c is not None and c.truth is not None), None)
    note = next(m.note for m in maps if m is not None)
    # The factors in the note are those of one run, and every run has its own.
    if note.startswith("scaled"):
        note = "scaled per channel\nto fit the truth"
    # The note repeats what follows a comma in the title.
    short_title = title.split(", ", 1)[0]
    return PictureRow(short_title, (truth, *(None if c is None else c.estimate for c in comparisons)), note)
