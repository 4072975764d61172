"""The picture of a comparison: a section a view, a column for the truth and each run, a row for each map."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import UInt8

from neilfpp_method.evaluate.panels import ComparedMap
from neilfpp_method.evaluate.pictures import Group, Row, Section, contact_sheet
from neilfpp_method.report.views import title_of

__all__ = ["Column", "comparison_sheet", "shortened"]

LETTERS_OF_A_LABEL = 27
"""As many fit above a picture of a sheet."""


@dataclass(frozen=True)
class Column:
    """What a run shows of the views: its label, and its maps, each with a comparison for every view."""

    label: str
    maps: tuple[ComparedMap, ...]


def comparison_sheet(
    title: str, views: Sequence[str], columns: Sequence[Column]
) -> UInt8[np.ndarray, "H W 3"]:
    """The sheet. A map that a run does not have leaves its cell empty, as does a truth that is not known.

    Args:
        title: of the sheet.
        views: names, in the order of every map's comparisons.
        columns: the runs, from left to right; the truth of a map is that of the first run that has one.
    """
    titles = list(dict.fromkeys(title_of(m) for column in columns for m in column.maps))
    by_title = [{title_of(m): m for m in column.maps} for column in columns]
    headings = ("truth", *(shortened(column.label) for column in columns))
    sections = []
    for i, view in enumerate(views):
        rows = tuple(_row(name, [maps.get(name) for maps in by_title], i) for name in titles)
        sections.append(Section((Group(f"View {view}", headings),), rows))
    many = f"{len(views)} views" if len(views) != 1 else "one view"
    return contact_sheet(title, f"{many} of {len(columns)} runs", sections)


def shortened(label: str) -> str:
    """The label where it fits above a picture, else its two ends."""
    if len(label) <= LETTERS_OF_A_LABEL:
        return label
    end = LETTERS_OF_A_LABEL // 2
    return f"{label[: LETTERS_OF_A_LABEL - end - 1]}…{label[-end:]}"


def _row(title: str, maps: Sequence[ComparedMap | None], view: int) -> Row:
    comparisons = [None if m is None else m.comparisons[view] for m in maps]
    truth = next((c.truth for c in comparisons if c is not None and c.truth is not None), None)
    note = next(m.note for m in maps if m is not None)
    if note.startswith("scaled"):  # by other factors in every run
        note = "scaled per channel\nto fit the truth"
    words = title.split(", ", 1)
    # What follows a comma in a title is said by the note as well.
    return Row(words[0], (truth, *(None if c is None else c.estimate for c in comparisons)), note)
