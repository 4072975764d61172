"""The table of a comparison in a terminal."""

from __future__ import annotations

from collections.abc import Iterator

from rich.table import Table
from rich.text import Text

from neilfpp_method.compare.parts import Part, Row
from neilfpp_method.compare.write import Comparison

__all__ = ["tables_of"]

ARROWS = {"higher": " ↑", "lower": " ↓", "neither": ""}
MARK = " *"
"""Behind a figure that is not to be compared with the others."""
TITLE_WIDTH = 32
WIDEST = 28
"""Letters of a column; longer texts go on in the next line."""


def tables_of(found: Comparison) -> Iterator[tuple[str, Table, tuple[str, ...]]]:
    """Title, table and notes of each part; the best of the figures that can be compared are bold."""
    texts = [[*found.labels], *(row.shown for part in found.parts for row in part.rows)]
    widths = [min(max(map(len, column)) + len(MARK), WIDEST) for column in zip(*texts, strict=True)]
    for part in found.parts:
        if not part.rows and not part.notes:
            continue
        table = Table(box=None, pad_edge=False, header_style="bold")
        table.add_column("", width=TITLE_WIDTH, overflow="fold")
        for label, width in zip(found.labels, widths, strict=True):
            table.add_column(Text(label), justify="right", width=width, overflow="fold")
        for row in part.rows:
            table.add_row(Text(row.title + ARROWS[row.better]), *_cells(part, row))
        yield part.title, table, part.notes


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
