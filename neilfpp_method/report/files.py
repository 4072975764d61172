"""A run's folder besides its model: progress, figures, times, findings, effects and settings."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, TypeVar

from neilfpp_method.errors import UserError
from neilfpp_method.health.cases import Finding
from neilfpp_method.report.measured import Measured, numbers, read_measured
from neilfpp_method.schedule import stage_steps
from neilfpp_method.settings.plain import to_dict
from neilfpp_method.settings.presets import PRESETS, fixed_geometry, free_light
from neilfpp_method.settings.types import MeshConfig, NeilfConfig
from neilfpp_method.train.health_record import read_findings
from neilfpp_method.train.quality import Look, read_looks
from neilfpp_method.train.run import read_description, read_json
from neilfpp_method.train.work_record import read_work

__all__ = ["Changed", "Files", "changed_settings", "flat_settings", "read_files"]

Read = TypeVar("Read")


@dataclass(frozen=True)
class Changed:
    """A setting that is not that of the preset; `usual` is none where the preset does not have it."""

    name: str
    value: str
    usual: str | None


@dataclass(frozen=True)
class Files:
    """What the files of a run say.

    Attributes:
        path: the run's folder.
        config: its settings.
        steps: of the whole training.
        findings: of its health; none: it has no record.
        measured: figures by protocol; empty where `neilfpp eval` was not called.
        timing: seconds of each stage.
        work: seconds of each stage by kind of work.
        looks: at held-back pixels, on the way.
        effects: a row per effect, as `effects.json` has them.
        machine: versions and hardware.
        notes: what could not be read.
    """

    path: Path
    config: NeilfConfig
    steps: int
    findings: list[Finding] | None
    measured: Mapping[str, Measured]
    timing: Mapping[str, float]
    work: Mapping[str, Mapping[str, float]]
    looks: Sequence[Look]
    effects: list[Mapping[str, Any]]
    machine: Mapping[str, Any]
    notes: list[str]


def read_files(path: Path) -> Files:
    """The files of a run. A damaged one besides its settings is left out, and a note says so.

    Raises:
        UserError: there is no run, or its settings cannot be read.
    """
    config = read_description(path).config
    notes: list[str] = []

    def tried(read: Callable[[], Read], else_: Read) -> Read:
        try:
            return read()
        except UserError as error:
            notes.append(str(error))
            return else_

    def optional(name: str) -> dict[str, Any]:
        return tried(lambda: read_json(path / name), {}) if (path / name).is_file() else {}

    measured, damaged = read_measured(path)
    notes += damaged
    rows = optional("effects.json").get("effects")
    return Files(
        path=path,
        config=config,
        steps=sum(stage_steps(config.train).values()),
        findings=tried(lambda: read_findings(path), None),
        measured=measured,
        timing=numbers(optional("timing.json")),
        work=tried(lambda: read_work(path), {}),
        looks=tried(lambda: read_looks(path), []),
        effects=[row for row in rows if isinstance(row, dict)] if isinstance(rows, list) else [],
        machine=optional("environment.json"),
        notes=notes,
    )


def changed_settings(config: NeilfConfig) -> list[Changed] | None:
    """The settings that are not those of the preset; none where the preset is not known."""
    name = config.preset.removesuffix("-mesh")
    if name in PRESETS:
        base = PRESETS[name]()
    elif name == NeilfConfig().preset:
        base = NeilfConfig()
    else:
        return None
    base = fixed_geometry(base) if isinstance(config.host, MeshConfig) else base
    base = free_light(base) if config.light.kind == "free" and base.light.kind != "free" else base
    own, usual = flat_settings(to_dict(config)), flat_settings(to_dict(base))
    return [
        Changed(key, str(value), None if key not in usual else str(usual[key]))
        for key, value in own.items()
        if key not in usual or usual[key] != value
    ]


def flat_settings(values: Mapping[str, Any], where: str = "") -> dict[str, Any]:
    """Nested settings by their dotted names.

    >>> flat_settings({"train": {"rays": 77}})
    {'train.rays': 77}
    """
    found: dict[str, Any] = {}
    for name, value in values.items():
        found |= (
            flat_settings(value, f"{where}{name}.")
            if isinstance(value, Mapping)
            else {f"{where}{name}": value}
        )
    return found
