"""Collect the figures of several runs under one protocol, and decide which can be compared."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

from neilfpp_method.compare.parts import TablePart, TableRow
from neilfpp_method.compare.runs import ComparedRun
from neilfpp_method.evaluate.glossary import style_of
from neilfpp_method.evaluate.published import PROTOCOLS
from neilfpp_method.report.measured import OWN, Measured

__all__ = ["SHOWN", "figure_rows", "figures_parts"]

SHOWN = "shown"
"""Name of the part with figures of the rendered views; the names of other parts are protocols."""


def figures_parts(runs: Sequence[ComparedRun], other_capture: frozenset[int]) -> list[TablePart]:
    """Build one part of the table for each protocol that at least one run was measured with.

    The first run that was measured is the reference for views, size and masks. A run that was measured
    differently, or is of another capture, is marked as not comparable, and a note says how to change that.

    Args:
        runs: the runs.
        other_capture: indices of runs of another capture.
    """
    return [
        _part(protocol, runs, other_capture)
        for protocol in (OWN, *PROTOCOLS)
        if any(protocol in run.files.measured for run in runs)
    ]


def figure_rows(figures: Sequence[Mapping[str, float]]) -> tuple[TableRow, ...]:
    """Build one row for each figure that at least one run has."""
    rows = []
    for name in dict.fromkeys(name for column in figures for name in column):
        style = style_of(name)
        values = tuple(column.get(name) for column in figures)
        texts = tuple("–" if value is None else style.format(value) for value in values)
        rows.append(TableRow(name, style.title, values, texts, style.better))
    return tuple(rows)


def _part(protocol: str, runs: Sequence[ComparedRun], other_capture: frozenset[int]) -> TablePart:
    measured = [run.files.measured.get(protocol) for run in runs]
    first = next(i for i, figures in enumerate(measured) if figures is not None)
    basis = measured[first]
    not_comparable, notes = set(other_capture), []
    for i, (run, figures) in enumerate(zip(runs, measured, strict=True)):
        if figures is None:
            notes.append(f"{run.label} was not measured: {_command(run, protocol, basis)}")
            continue
        if figures.outdated:
            notes.append(
                f"{run.label}: its figures are older than its checkpoint: {_command(run, protocol, basis)}"
            )
        difference = _difference(runs[first], basis, run, figures) if i != first else ""
        if difference:
            not_comparable.add(i)
            notes.append(difference)
    extent = f", {basis.extent}" if basis.extent else ""
    rows = figure_rows([{} if figures is None else figures.figures for figures in measured])
    title = f"Protocol {protocol}{extent}"
    return TablePart("figures", protocol, title, rows, frozenset(not_comparable), tuple(notes))


def _difference(first: ComparedRun, basis: Measured, run: ComparedRun, figures: Measured) -> str:
    """Why the figures of a run cannot be compared with those of the first; empty if they can."""
    protocol = basis.protocol
    for measured_run, known in ((first, basis), (run, figures)):
        if not known.extent:
            return (
                f"{measured_run.label} was measured by an earlier version, its views and size are not known: "
                f"{_command(measured_run, protocol)}"
            )
    if figures.views != basis.views:
        return (
            f"{run.label} was measured on other views ({figures.extent}) than {first.label} "
            f"({basis.extent}); train both with the same --test-every"
        )
    if figures.size != basis.size:
        return (
            f"{run.label} was measured on {figures.extent}, {first.label} on {basis.extent}: "
            f"{_command(run, protocol, basis)}"
        )
    if figures.description.get("mask_source") != basis.description.get("mask_source"):
        return (
            f"the masks of {run.label} come from {figures.description.get('mask_source')}, those of "
            f"{first.label} from {basis.description.get('mask_source')}: give both captures the same masks, "
            "and measure again"
        )
    return ""


def _command(run: ComparedRun, protocol: str, basis: Measured | None = None) -> str:
    """The command that measures a run, at the size of `basis` if it is known."""
    option = "" if protocol == OWN else f" --protocol {protocol}"
    width = f" --width {basis.size[0]}" if basis is not None and basis.size else ""
    return f"neilfpp eval {run.path}{option}{width}"
