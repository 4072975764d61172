"""The table of a comparison in a terminal."""

from __future__ import annotations

from collections.abc import Iterator

from rich.console import Group
from rich.table import Table
from rich.text import Text

from neilfpp_method.compare.parts import Part, Row
from neilfpp_method.compare.write import Comparison

__all__ = ["table_of"]

ARROWS = {"higher": " ↑", "lower": " ↓", "neither": ""}
MARK = " *"
"""Behind a figure that is not to be compared with the others."""


def table_of(found: Comparison) -> Group:
    """The table with its notes; the best of the figures that can be compared are bold."""
    shown = Table(box=None, pad_edge=False, header_style="bold")
    shown.add_column("", overflow="fold")
    for label in found.labels:
        shown.add_column(Text(label), justify="right", overflow="fold")
    notes = list(found.notes)
    for part in found.parts:
        if not part.rows and not part.notes:
            continue
        shown.add_row()
        shown.add_row(Text(part.title, style="bold"))
        for row in part.rows:
            shown.add_row(Text(row.title + ARROWS[row.better]), *_cells(part, row))
        notes += part.notes
    return Group(shown, "", *(Text(f"* {note}") for note in notes))


def _cells(part: Part, row: Row) -> Iterator[Text]:
    best = _best(part, row)
    for i, text in enumerate(row.shown):
        mark = MARK if i in part.apart and row.values[i] is not None else ""
        yield Text(text + mark, style="bold" if i in best else "")


def _best(part: Part, row: Row) -> set[int]:
    """The runs with the best value, of those that can be compared; none where there is nothing to compare."""
    values = {
        i: value
        for i, value in enumerate(row.values)
        if isinstance(value, float | int) and i not in part.apart
    }
    if row.better == "neither" or len(set(values.values())) < 2:
        return set()
    best = max(values.values()) if row.better == "higher" else min(values.values())
    return {i for i, value in values.items() if value == best}
