"""Figures of several runs under one protocol, and whether they can be compared."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

from neilfpp_method.compare.contenders import Contender
from neilfpp_method.compare.parts import Part, Row
from neilfpp_method.evaluate.glossary import explain
from neilfpp_method.evaluate.published import PROTOCOLS
from neilfpp_method.report.measured import OWN, Measured

__all__ = ["SHOWN", "figure_rows", "figures_parts"]

SHOWN = "shown"
"""The name of the figures that are of the views in the picture."""


def figures_parts(runs: Sequence[Contender], other_capture: frozenset[int]) -> list[Part]:
    """A part for each protocol that some run was measured with.

    The first run that was measured sets the views and the size; the figures of a run that was measured on
    others, and of a run of another capture, stand apart, with a note that says what makes them equal.
    """
    return [
        _part(protocol, runs, other_capture)
        for protocol in (OWN, *PROTOCOLS)
        if any(protocol in run.files.measured for run in runs)
    ]


def figure_rows(figures: Sequence[Mapping[str, float]]) -> tuple[Row, ...]:
    """A row for each figure that some run has."""
    rows = []
    for name in dict.fromkeys(name for column in figures for name in column):
        entry = explain(name)
        values = tuple(column.get(name) for column in figures)
        shown = tuple("–" if value is None else entry.format(value) for value in values)
        rows.append(Row(name, entry.title, values, shown, entry.better))
    return tuple(rows)


def _part(protocol: str, runs: Sequence[Contender], other_capture: frozenset[int]) -> Part:
    measured = [run.files.measured.get(protocol) for run in runs]
    at = next(i for i, figures in enumerate(measured) if figures is not None)
    basis = measured[at]
    apart, notes = set(other_capture), []
    for i, (run, figures) in enumerate(zip(runs, measured, strict=True)):
        if figures is None:
            notes.append(f"{run.label} was not measured: {_command(run, protocol, basis)}")
            continue
        if figures.outdated:
            notes.append(
                f"{run.label}: its figures are older than its checkpoint: {_command(run, protocol, basis)}"
            )
        difference = _difference(runs[at], basis, run, figures) if i != at else ""
        if difference:
            apart.add(i)
            notes.append(difference)
    extent = f", {basis.extent}" if basis.extent else ""
    rows = figure_rows([{} if figures is None else figures.figures for figures in measured])
    return Part("figures", protocol, f"Protocol {protocol}{extent}", rows, frozenset(apart), tuple(notes))


def _difference(first: Contender, basis: Measured, run: Contender, figures: Measured) -> str:
    """Why the figures of a run do not compare with those of the first, and what makes them equal; empty:
    they do.
    """
    protocol = basis.protocol
    for contender, known in ((first, basis), (run, figures)):
        if not known.extent:
            return (
                f"{contender.label}: an earlier version measured it, and its views and size are not known: "
                f"{_command(contender, protocol)}"
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
    if figures.said.get("mask_source") != basis.said.get("mask_source"):
        return (
            f"{run.label} counts pixels by {figures.said.get('mask_source')}, {first.label} by "
            f"{basis.said.get('mask_source')}: give both captures the same masks, and measure again"
        )
    return ""


def _command(run: Contender, protocol: str, basis: Measured | None = None) -> str:
    """What measures a run, at the size of another where that is known."""
    option = "" if protocol == OWN else f" --protocol {protocol}"
    width = f" --width {basis.size[0]}" if basis is not None and basis.size else ""
    return f"neilfpp eval {run.path}{option}{width}"
