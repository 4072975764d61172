"""Read the files of a run other than its model: settings, figures, times, findings and effects."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any, TypeVar

from neilfpp_method.errors import UserError
from neilfpp_method.evaluate.published import PROTOCOLS
from neilfpp_method.health.cases import Finding
from neilfpp_method.report.measured import OWN, Measured, numbers, read_measured
from neilfpp_method.schedule import stage_steps
from neilfpp_method.settings.plain import to_dict
from neilfpp_method.settings.presets import PRESETS, fixed_geometry, free_light
from neilfpp_method.settings.types import MeshConfig, NeilfConfig
from neilfpp_method.train.health_record import read_findings
from neilfpp_method.train.json_files import read_json
from neilfpp_method.train.quality import QualityCheck, read_checks
from neilfpp_method.train.run import read_description
from neilfpp_method.train.work_record import read_work

__all__ = ["Changed", "Files", "changed_settings", "flat_settings", "read_files"]

Read = TypeVar("Read")


@dataclass(frozen=True)
class Changed:
    """A setting that differs from the preset; `preset_value` is None if the preset has no such setting."""

    name: str
    value: str
    preset_value: str | None


@dataclass(frozen=True)
class Files:
    """The contents of a run's files.

    Attributes:
        path: the run's folder.
        config: the settings of the run.
        steps: number of steps of the whole training.
        findings: findings of the health checks; None if the run has no record of them.
        measured: figures by protocol, this project's own first; empty if the run was not evaluated.
        timing: seconds by stage.
        work: seconds by stage and kind of work.
        checks: measurements at held-back pixels during training.
        effects: one row per effect, from `effects.json`.
        machine: hardware and package versions, from `environment.json`.
        notes: one message per file that could not be read.
    """

    path: Path
    config: NeilfConfig
    steps: int
    findings: list[Finding] | None
    measured: Mapping[str, Measured]
    timing: Mapping[str, float]
    work: Mapping[str, Mapping[str, float]]
    checks: Sequence[QualityCheck]
    effects: list[Mapping[str, Any]]
    machine: Mapping[str, Any]
    notes: list[str]

    @property
    def has_results(self) -> bool:
        """Whether any file has a result: a finding, a figure or a time, not only settings and effects."""
        return any((self.findings, self.measured, self.timing, self.work, self.checks))


def read_files(path: Path) -> Files:
    """Read the files of a run. A damaged file is skipped and noted, unless it holds the settings.

    Raises:
        UserError: there is no run, or its settings cannot be read.
    """
    config = read_description(path).config
    notes: list[str] = []

    def read_or(read: Callable[[], Read], default: Read) -> Read:
        try:
            return read()
        except UserError as error:
            notes.append(str(error))
            return default

    def optional_json(name: str) -> dict[str, Any]:
        return read_or(lambda: read_json(path / name), {}) if (path / name).is_file() else {}

    protocols = (OWN, *PROTOCOLS)
    measured = {name: read_or(partial(read_measured, path, name), None) for name in protocols}
    rows = optional_json("effects.json").get("effects")
    return Files(
        path=path,
        config=config,
        steps=sum(stage_steps(config.train).values()),
        findings=read_or(lambda: read_findings(path), None),
        measured={name: figures for name, figures in measured.items() if figures is not None},
        timing=numbers(optional_json("timing.json")),
        work=read_or(lambda: read_work(path), {}),
        checks=read_or(lambda: read_checks(path), []),
        effects=[row for row in rows if isinstance(row, dict)] if isinstance(rows, list) else [],
        machine=optional_json("environment.json"),
        notes=notes,
    )


def changed_settings(config: NeilfConfig) -> list[Changed] | None:
    """List the settings that differ from the run's preset; None if this version does not know the preset."""
    name = config.preset.removesuffix("-mesh")
    if name in PRESETS:
        base = PRESETS[name]()
    elif name == NeilfConfig().preset:
        base = NeilfConfig()
    else:
        return None
    base = fixed_geometry(base) if isinstance(config.host, MeshConfig) else base
    base = free_light(base) if config.light.kind == "free" and base.light.kind != "free" else base
    own, preset = flat_settings(to_dict(config)), flat_settings(to_dict(base))
    return [
        Changed(key, str(value), str(preset[key]) if key in preset else None)
        for key, value in own.items()
        if key not in preset or preset[key] != value
    ]


def flat_settings(values: Mapping[str, Any], prefix: str = "") -> dict[str, Any]:
    """Flatten nested settings to dotted names.

    >>> flat_settings({"train": {"rays": 77}})
    {'train.rays': 77}
    """
    flat: dict[str, Any] = {}
    for name, value in values.items():
        if isinstance(value, Mapping):
            flat |= flat_settings(value, f"{prefix}{name}.")
        else:
            flat[f"{prefix}{name}"] = value
    return flat
