"""Parts of the table of a comparison: the runs, the settings that differ, and the times."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, Literal

from neilfpp_method.compare.runs import ComparedRun
from neilfpp_method.health.cases import verdict_of
from neilfpp_method.report.files import flat_settings
from neilfpp_method.report.tables import STAGE_TITLES
from neilfpp_method.settings.plain import to_dict

__all__ = ["TablePart", "TableRow", "runs_part", "seconds_part", "settings_part"]

Value = float | str | None


@dataclass(frozen=True)
class TableRow:
    """A row of the table.

    Attributes:
        key: name in files.
        title: name for display.
        values: one value per run; None if the run has none.
        texts: the values formatted for display.
        better: whether higher or lower values are better.
    """

    key: str
    title: str
    values: tuple[Value, ...]
    texts: tuple[str, ...]
    better: Literal["higher", "lower", "neither"] = "neither"


@dataclass(frozen=True)
class TablePart:
    """Rows of the table under one heading.

    Attributes:
        kind: "runs", "settings", "seconds" or "figures".
        name: the protocol of figures; empty for other kinds.
        title: heading for display.
        rows: the rows.
        not_comparable: indices of the runs whose values cannot be compared with the others.
        notes: the reasons, and what would make the values comparable.
    """

    kind: Literal["runs", "settings", "seconds", "figures"]
    name: str
    title: str
    rows: tuple[TableRow, ...]
    not_comparable: frozenset[int] = frozenset()
    notes: tuple[str, ...] = ()


def runs_part(runs: Sequence[ComparedRun]) -> TablePart:
    """Build the part that identifies the runs: folder, capture, preset, geometry, steps and health."""
    rows = (
        _text_row("folder", "Folder", [run.path for run in runs]),
        _text_row("capture", "Capture", [run.capture.root.resolve().name for run in runs]),
        _text_row("preset", "Preset", [run.files.config.preset for run in runs]),
        _text_row("host", "Geometry", [run.files.config.host.kind for run in runs]),
        _text_row("steps", "Steps", [f"{run.step} of {run.files.steps}" for run in runs]),
        _text_row("health", "Health", [_health(run) for run in runs]),
    )
    notes = [f"{run.label}: {note}" for run in runs for note in run.files.notes]
    notes += [
        f"{run.label} was stopped before its first checkpoint and cannot be rendered; to continue it: "
        f"neilfpp train --out {run.path} --resume"
        for run in runs
        if not run.has_model
    ]
    return TablePart("runs", "", "Runs", rows, notes=tuple(notes))


def settings_part(runs: Sequence[ComparedRun]) -> TablePart:
    """Build the part with settings, options of reading the capture, and effects that differ between runs."""
    columns = [_settings(run) for run in runs]
    names = list(dict.fromkeys(name for column in columns for name in column))
    differing = [name for name in names if len({str(column.get(name)) for column in columns}) > 1]
    rows = tuple(_text_row(name, name, [column.get(name) for column in columns]) for name in differing)
    return TablePart("settings", "", "Settings that differ", rows)


def seconds_part(runs: Sequence[ComparedRun]) -> TablePart:
    """Build the part with seconds by stage, by kind of work, and in total; a note says if machines differ."""
    stages = [run.files.seconds for run in runs]
    kinds = [_kinds(run) for run in runs]
    rows = [
        _seconds_row(stage, STAGE_TITLES.get(stage, stage), [column.get(stage) for column in stages])
        for stage in dict.fromkeys(stage for column in stages for stage in column)
    ]
    totals = [sum(column.values()) if column else None for column in stages]
    rows.append(_seconds_row("together", "Total", totals))
    for kind in dict.fromkeys(kind for column in kinds for kind in column):
        title = f"of which {kind.replace('_', ' ')}"
        rows.append(_seconds_row(f"work.{kind}", title, [column.get(kind) for column in kinds]))
    machines = {_machine(run): run.label for run in reversed(runs)}
    notes = []
    if len(machines) > 1:
        notes.append(
            "the runs used different machines, so their times cannot be compared: "
            + "; ".join(f"{label} on {machine}" for machine, label in reversed(machines.items()))
        )
    return TablePart("seconds", "", "Seconds", tuple(rows), notes=tuple(notes))


def _health(run: ComparedRun) -> str | None:
    return None if run.files.findings is None else verdict_of(run.files.findings)


def _settings(run: ComparedRun) -> dict[str, Any]:
    source = {f"capture.{name}": value for name, value in dataclasses.asdict(run.source).items()}
    effects = {f"effect {row['effect']}": row.get("decision") for row in run.files.effects if "effect" in row}
    return source | flat_settings(to_dict(run.files.config)) | effects


def _kinds(run: ComparedRun) -> dict[str, float]:
    totals: dict[str, float] = {}
    for parts in run.files.work.values():
        for kind, seconds in parts.items():
            totals[kind] = totals.get(kind, 0.0) + seconds
    return totals


def _machine(run: ComparedRun) -> str:
    machine = run.files.machine
    devices = [str(machine.get("processor")), *run.files.gpus]
    return f"{' and '.join(devices)}, {machine.get('threads')} threads" if machine else "an unknown machine"


def _text_row(key: str, title: str, values: Sequence[Any]) -> TableRow:
    texts = tuple(None if value is None else str(value) for value in values)
    return TableRow(key, title, texts, tuple("–" if text is None else text for text in texts))


def _seconds_row(key: str, title: str, values: Sequence[float | None]) -> TableRow:
    texts = tuple("–" if value is None else f"{value:.1f}" for value in values)
    return TableRow(key, title, tuple(values), texts, better="lower")
