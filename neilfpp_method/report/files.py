"""Read the files of a run other than its model: settings, figures, times, findings and effects."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any, TypeVar

import numpy as np
from jaxtyping import UInt8

from neilfpp_method.data.files.images import read_image
from neilfpp_method.errors import UserError
from neilfpp_method.evaluate.published import PROTOCOLS
from neilfpp_method.health.cases import Finding
from neilfpp_method.report.measured import OWN, Measured, finite_numbers, read_measured
from neilfpp_method.schedule import Stage, total_steps
from neilfpp_method.settings.plain import to_dict
from neilfpp_method.settings.presets import PRESETS, fixed_geometry, free_light
from neilfpp_method.settings.types import MeshConfig, NeilfConfig
from neilfpp_method.train.health_record import read_findings
from neilfpp_method.train.json_files import read_json
from neilfpp_method.train.quality import QualityCheck, read_checks
from neilfpp_method.train.run import read_description
from neilfpp_method.train.work_record import read_work

__all__ = ["ChangedSetting", "RunFiles", "changed_settings", "flat_settings", "read_files"]

Read = TypeVar("Read")


@dataclass(frozen=True)
class ChangedSetting:
    """A setting that differs from the preset; `preset_value` is None if the preset has no such setting."""

    name: str
    value: str
    preset_value: str | None


@dataclass(frozen=True)
class RunFiles:
    """The contents of a run's files.

    Attributes:
        path: the run's folder.
        config: the settings of the run.
        steps: number of steps of the whole training.
        findings: findings of the health checks; None if the run has no record of them.
        measured: figures by protocol, this project's own first; empty if the run was not evaluated.
        timing: seconds by stage, without kinds of work.
        work: seconds by stage and kind of work; empty for a run of an earlier version.
        checks: measurements at held-back pixels during training.
        previews: image at the end of each stage, by the name of the stage.
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
    previews: Mapping[str, UInt8[np.ndarray, "H W 3"]]
    effects: list[Mapping[str, Any]]
    machine: Mapping[str, Any]
    notes: list[str]

    @property
    def has_results(self) -> bool:
        """Whether any file has a result: a finding, a figure or a time, not only settings and effects."""
        return any((self.findings, self.measured, self.timing, self.work, self.checks))

    @property
    def seconds(self) -> Mapping[str, float]:
        """Seconds by stage; empty if no stage has been timed."""
        return {stage: sum(parts.values()) for stage, parts in self.work.items()} or self.timing

    @property
    def gpus(self) -> list[str]:
        """Names of the GPUs of the machine; empty if there are none, or the machine is not known."""
        gpus = self.machine.get("gpus")
        return [str(gpu) for gpu in gpus] if isinstance(gpus, list) else []


def read_files(path: Path) -> RunFiles:
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

    def seconds_of_stages() -> dict[str, float]:
        file = path / "timing.json"
        return finite_numbers(file, read_json(file)) if file.is_file() else {}

    protocols = (OWN, *PROTOCOLS)
    measured = {name: read_or(partial(read_measured, path, name), None) for name in protocols}
    pictures = {stage.value: path / "previews" / f"{stage.value}.png" for stage in Stage}
    previews = {
        name: read_or(partial(_picture, file), None) for name, file in pictures.items() if file.is_file()
    }
    rows = optional_json("effects.json").get("effects")
    return RunFiles(
        path=path,
        config=config,
        steps=total_steps(config.train),
        findings=read_or(lambda: read_findings(path), None),
        measured={name: figures for name, figures in measured.items() if figures is not None},
        timing=read_or(seconds_of_stages, {}),
        work=read_or(lambda: read_work(path), {}),
        checks=read_or(lambda: read_checks(path), []),
        previews={name: pixels for name, pixels in previews.items() if pixels is not None},
        effects=[row for row in rows if isinstance(row, dict)] if isinstance(rows, list) else [],
        machine=optional_json("environment.json"),
        notes=notes,
    )


def _picture(file: Path) -> UInt8[np.ndarray, "H W 3"]:
    return (read_image(file).pixels * 255).round().astype(np.uint8)


def changed_settings(config: NeilfConfig) -> list[ChangedSetting] | None:
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
        ChangedSetting(key, str(value), str(preset[key]) if key in preset else None)
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
