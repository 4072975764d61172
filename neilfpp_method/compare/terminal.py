"""The table of a comparison for the terminal."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

from rich.table import Table
from rich.text import Text

from neilfpp_method.compare.parts import TablePart, TableRow
from neilfpp_method.compare.write import RunComparison

__all__ = ["PrintedPart", "printed_parts"]

ARROWS = {"higher": " ↑", "lower": " ↓", "neither": ""}
"""Suffix of a row's title, which shows whether higher or lower values are better."""
MARK = " *"
"""Suffix of a figure that cannot be compared with the others."""
TITLE_WIDTH = 32
"""Width of the titles of rows, characters."""
WIDEST = 28
"""Largest width of a column, characters; longer texts are wrapped."""


@dataclass(frozen=True)
class PrintedPart:
    """A part of the table as it is printed: a title, a table, and notes below it."""

    title: str
    table: Table
    notes: tuple[str, ...]


def printed_parts(comparison: RunComparison) -> Iterator[PrintedPart]:
    """Yield the parts that have rows or notes. The best value among comparable figures is bold."""
    texts = [[*comparison.labels], *(row.texts for part in comparison.parts for row in part.rows)]
    widths = [min(max(map(len, column)) + len(MARK), WIDEST) for column in zip(*texts, strict=True)]
    for part in comparison.parts:
        if not part.rows and not part.notes:
            continue
        table = Table(box=None, pad_edge=False, header_style="bold")
        table.add_column("", width=TITLE_WIDTH, overflow="fold")
        for label, width in zip(comparison.labels, widths, strict=True):
            table.add_column(Text(label), justify="right", width=width, overflow="fold")
        for row in part.rows:
            table.add_row(Text(row.title + ARROWS[row.better]), *_cells(part, row))
        yield PrintedPart(part.title, table, part.notes)


def _cells(part: TablePart, row: TableRow) -> Iterator[Text]:
    best = _best(part, row)
    for i, text in enumerate(row.texts):
        mark = MARK if i in part.not_comparable and row.values[i] is not None else ""
        yield Text(text + mark, style="bold" if i in best else "")


def _best(part: TablePart, row: TableRow) -> set[int]:
    """Indices of the comparable runs with the best value; empty if fewer than two values differ."""
    values = {
        i: value
        for i, value in enumerate(row.values)
        if isinstance(value, float | int) and i not in part.not_comparable
    }
    if row.better == "neither" or len(set(values.values())) < 2:
        return set()
    best = max(values.values()) if row.better == "higher" else min(values.values())
    return {i for i, value in values.items() if value == best}
