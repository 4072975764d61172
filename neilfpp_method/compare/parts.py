"""The parts of the table: what the runs are, where their settings differ, and seconds."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, Literal

from neilfpp_method.compare.contenders import Contender
from neilfpp_method.health.cases import verdict_of
from neilfpp_method.report.files import flat_settings
from neilfpp_method.report.tables import STAGE_TITLES
from neilfpp_method.settings.plain import to_dict

__all__ = ["Part", "Row", "runs_part", "seconds_part", "settings_part"]

Value = float | str | None


@dataclass(frozen=True)
class Row:
    """A line of the table: a value for each run, none where there is none; `shown` are the same in words."""

    key: str
    title: str
    values: tuple[Value, ...]
    shown: tuple[str, ...]
    better: Literal["higher", "lower", "neither"] = "neither"


@dataclass(frozen=True)
class Part:
    """Lines of the table that belong together.

    Attributes:
        kind: "runs", "settings", "seconds" or "figures".
        name: which figures, by their protocol; empty for other kinds.
        title: for people.
        rows: the lines.
        apart: the runs, by number, whose values are not to be compared with the others'.
        notes: why, and what makes them equal.
    """

    kind: Literal["runs", "settings", "seconds", "figures"]
    name: str
    title: str
    rows: tuple[Row, ...]
    apart: frozenset[int] = frozenset()
    notes: tuple[str, ...] = ()


def runs_part(runs: Sequence[Contender]) -> Part:
    """What the runs are."""
    lines = {
        "folder": ("Folder", [str(run.path) for run in runs]),
        "capture": ("Capture", [run.capture.root.resolve().name for run in runs]),
        "preset": ("Preset", [run.files.config.preset for run in runs]),
        "host": ("Geometry", [run.files.config.host.kind for run in runs]),
        "steps": ("Steps", [f"{run.step} of {run.files.steps}" for run in runs]),
        "health": ("Health", [_health(run) for run in runs]),
    }
    notes = [f"{run.label}: {note}" for run in runs for note in run.files.notes]
    notes += [
        f"{run.label} was stopped before its first checkpoint and has nothing to show; it goes on with: "
        f"neilfpp train --out {run.path} --resume"
        for run in runs
        if not run.has_model
    ]
    rows = tuple(_words(key, title, values) for key, (title, values) in lines.items())
    return Part("runs", "", "Runs", rows, notes=tuple(notes))


def settings_part(runs: Sequence[Contender]) -> Part:
    """The settings, the reading of the capture and the decided effects that are not the same in all runs."""
    columns = [_settings(run) for run in runs]
    names = list(dict.fromkeys(name for column in columns for name in column))
    differing = [name for name in names if len({str(column.get(name)) for column in columns}) > 1]
    rows = tuple(_words(name, name, [column.get(name) for column in columns]) for name in differing)
    return Part("settings", "", "Settings that differ", rows)


def seconds_part(runs: Sequence[Contender]) -> Part:
    """Seconds of each stage, of each kind of work, and together; notes where machines differ."""
    stages = [_stages(run) for run in runs]
    kinds = [_kinds(run) for run in runs]
    rows = [
        _seconds(stage, STAGE_TITLES.get(stage, stage), [column.get(stage) for column in stages])
        for stage in dict.fromkeys(stage for column in stages for stage in column)
    ]
    together = [sum(column.values()) if column else None for column in stages]
    rows.append(_seconds("together", "Together", together))
    rows += [
        _seconds(f"work.{kind}", f"of which {kind.replace('_', ' ')}", [column.get(kind) for column in kinds])
        for kind in dict.fromkeys(kind for column in kinds for kind in column)
    ]
    machines = {_machine(run): run.label for run in reversed(runs)}
    notes = []
    if len(machines) > 1:
        notes.append(
            "machines differ, so seconds tell little: "
            + "; ".join(f"{label} on {machine}" for machine, label in reversed(machines.items()))
        )
    return Part("seconds", "", "Seconds", tuple(rows), notes=tuple(notes))


def _health(run: Contender) -> str | None:
    return None if run.files.findings is None else verdict_of(run.files.findings)


def _settings(run: Contender) -> dict[str, Any]:
    source = {f"capture.{name}": value for name, value in dataclasses.asdict(run.source).items()}
    effects = {f"effect {row['effect']}": row.get("decision") for row in run.files.effects if "effect" in row}
    return source | flat_settings(to_dict(run.files.config)) | effects


def _stages(run: Contender) -> dict[str, float]:
    if run.files.work:
        return {stage: sum(parts.values()) for stage, parts in run.files.work.items()}
    return dict(run.files.timing)


def _kinds(run: Contender) -> dict[str, float]:
    found: dict[str, float] = {}
    for parts in run.files.work.values():
        for kind, seconds in parts.items():
            found[kind] = found.get(kind, 0.0) + seconds
    return found


def _machine(run: Contender) -> str:
    machine = run.files.machine
    gpus = machine.get("gpus")
    devices = [str(machine.get("processor")), *map(str, gpus if isinstance(gpus, list) else ())]
    return f"{' and '.join(devices)}, {machine.get('threads')} threads" if machine else "an unknown machine"


def _words(key: str, title: str, values: Sequence[Any]) -> Row:
    texts = tuple(None if value is None else str(value) for value in values)
    return Row(key, title, texts, tuple("–" if text is None else text for text in texts))


def _seconds(key: str, title: str, values: Sequence[float | None]) -> Row:
    shown = tuple("–" if value is None else f"{value:.1f}" for value in values)
    return Row(key, title, tuple(values), shown, better="lower")
