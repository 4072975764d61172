"""`neilfpp train`."""

from __future__ import annotations

import os
from collections.abc import Mapping, Sequence
from contextlib import AbstractContextManager, nullcontext
from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated, Any, Literal

import tyro

from neilfpp_method.commands.command import Command, Device, terminal
from neilfpp_method.commands.report import after_training
from neilfpp_method.errors import UserError
from neilfpp_method.settings.files import read_settings
from neilfpp_method.settings.plain import changed
from neilfpp_method.settings.presets import PRESETS, fixed_geometry, free_light, preset
from neilfpp_method.settings.types import MapLightConfig, MeshConfig, NeilfConfig

__all__ = ["COMMAND"]

DEFAULT_PRESET = "fast"
"""Preset if neither --preset nor a settings file names one."""
ROOMS_WITH_KINDS = ("light", "encoding")
"""Groups of settings whose members depend on their `kind`. The kind of the host is the option --host."""


@dataclass
class Train:
    """Recover geometry, material and light from posed images."""

    data: Path | None = None
    """Folder of the capture; not with --resume."""
    out: Path | None = None
    """Run folder; default: runs/CAPTURE-PRESET."""
    preset: str | None = None
    """fast (minutes on a CPU), balanced or best (hours: docs/budget.md), or the published settings paper-mlp,
    paper-ngp, paper-ngp-hdr; default: fast.
    """
    config_file: Annotated[Path | None, tyro.conf.arg(name="config", metavar="FILE")] = None
    """Settings from a .yaml or .json file; other options override it."""
    host: Literal["volsdf", "mesh"] = "volsdf"
    """Source of geometry: recovered from the images (volsdf), or a given mesh."""
    mesh: Path | None = None
    """Mesh in the capture's world frame; default: that of the capture."""
    light: Path | None = None
    """A known environment map (linear EXR, docs/light.md); default: recovered."""
    resume: bool = False
    """Continue the run in --out from its last checkpoint."""
    format: str | None = None
    """Format of the capture (see docs/captures.md); default: recognised from the files."""
    test_every: int | None = None
    """Hold out every k-th view for testing; default: split.json, or every 8th."""
    response: Literal["auto", "linear", "srgb"] = "auto"
    """What the pixels hold: linear radiance (HDR) or sRGB (LDR); auto: as the files say."""
    scale: float | None = None
    """Image size relative to the files; default: as training can use."""
    effects: str | None = None
    """Effects to simulate: auto, all, none, as-set, or a list such as auto,-lamps (docs/effects.md)."""
    budget: str | None = None
    """Time of the command, such as 10m; default: no limit."""
    view: bool = False
    """Serve the viewer while the run trains (docs/viewer.md)."""
    strict: bool = False
    """Exit status 1 if the result is unusable."""
    device: Device = "auto"
    """Device to train on; auto selects a GPU if there is one."""
    devices: int = 1
    """Processes on this machine, one per GPU."""
    nodes: int = 1
    """Machines, by torchrun (docs/machines.md)."""


@dataclass
class TrainWithSettings(Train):
    """Recover geometry, material and light from posed images."""

    config: NeilfConfig = field(default_factory=NeilfConfig)
    """Individual settings, which override those of the preset."""
    view_port: int = 8080
    """Port of --view."""
    report: bool = True
    """Write RUN/report.html at the end (docs/report.md)."""


def run(options: TrainWithSettings) -> None:
    from neilfpp_method.budget.durations import read_duration
    from neilfpp_method.effects.request import parse_effects
    from neilfpp_method.kernels.process import computing_fast
    from neilfpp_method.train.command import run_training
    from neilfpp_method.train.request import TrainingRequest

    budget = None if options.budget is None else read_duration(options.budget)
    config = _with_files(options)
    named = options.preset is not None or options.config_file is not None
    as_before = options.resume and not named and config == preset(DEFAULT_PRESET)
    published = config.preset.startswith("paper-")
    effects = (
        None
        if options.resume and options.effects is None
        else parse_effects(options.effects or ("as-set" if published else "auto"))
    )
    with computing_fast(), _viewer(options, config):
        request = TrainingRequest(
            data=options.data,
            out=options.out,
            config=None if as_before else config,
            resume=options.resume,
            test_every=options.test_every,
            response=options.response,
            format=options.format,
            scale=options.scale,
            device=options.device,
            devices=options.devices,
            nodes=options.nodes,
            strict=options.strict,
            effects=effects,
            budget=budget,
        )
        write_report = (lambda path: after_training(path, options.device)) if options.report else None
        run_training(request, terminal(), write_report)


def _viewer(options: TrainWithSettings, config: NeilfConfig) -> AbstractContextManager[object]:
    """The viewer beside the training, if requested; only the first of several processes starts one."""
    from neilfpp_method.train.output import default_folder
    from neilfpp_method.view.beside import viewer_beside

    if not options.view or os.environ.get("LOCAL_RANK", "0") != "0":
        return nullcontext()
    out = options.out or (options.data and default_folder(options.data, config))
    if out is None:
        return nullcontext()  # `run_training` names the missing option.
    return viewer_beside(
        out, options.view_port, options.device, lambda text: terminal().print(text, soft_wrap=True)
    )


def _with_files(options: TrainWithSettings) -> NeilfConfig:
    """The settings with the files of --mesh and --light."""
    config = options.config
    if options.mesh is not None:
        if not isinstance(config.host, MeshConfig):
            raise UserError(
                f"--mesh {options.mesh}: the host {config.host.kind} takes no mesh", "add --host mesh"
            )
        config = changed(config, {"host.path": str(options.mesh.resolve())})
    if options.light is not None:
        if not isinstance(config.light, MapLightConfig):
            raise UserError(
                f"{options.light}: a light that is free at every point takes no map",
                "add --config.light.kind distant, or auto to look for near lamps as well",
            )
        config = changed(config, {"light.map": str(options.light.resolve())})
    return config


def _starting_point(arguments: Sequence[str]) -> TrainWithSettings:
    """Default options for a command line.

    The settings file, the preset, the host, and the kinds of light and encoding are read before all other
    options, because they determine which settings exist and what their defaults are.
    """
    file = _option(arguments, "--config")
    stored = dict(read_settings(Path(file))) if file is not None else {}
    where = file or "config"
    host = _option(arguments, "--host")
    config = _base(_option(arguments, "--preset"), host, stored, where)
    config = changed(config, stored, where)
    if host is not None and host != config.host.kind:
        raise UserError(
            f"{where}: its host is {config.host.kind}, but --host is {host}", "leave one of them out"
        )
    kinds = {room: _option(arguments, f"--config.{room}.kind") for room in ROOMS_WITH_KINDS}
    changes = {f"{room}.kind": kind for room, kind in kinds.items() if kind is not None}
    if kinds["light"] == "free" and config.light.kind != "free":
        config = free_light(config)
    return TrainWithSettings(config=changed(config, changes, "--config"))


def _base(name: str | None, host: str | None, stored: Mapping[str, Any], where: str) -> NeilfConfig:
    """The preset to which a settings file is applied: that of --preset, of the file, or the default."""
    label = stored.get("preset", DEFAULT_PRESET) if name is None else name
    kind = stored.get("host", {})
    mesh = (
        host == "mesh"
        or (isinstance(kind, Mapping) and kind.get("kind") == "mesh")
        or stored.get("host.kind") == "mesh"
    )
    if not isinstance(label, str):
        raise UserError(f"{where}.preset: {label!r} is not a name", f"choose one of {', '.join(PRESETS)}")
    label = label.removesuffix("-mesh") if name is None else label
    # Settings that no preset made carry the label of the default settings.
    config = NeilfConfig() if name is None and label == NeilfConfig().preset else preset(label)
    config = fixed_geometry(config) if mesh else config
    light = stored.get("light", {})
    free = isinstance(light, Mapping) and light.get("kind") == "free" and config.light.kind != "free"
    return free_light(config) if free else config


def _option(arguments: Sequence[str], name: str) -> str | None:
    """The value of an option in a command line; the last one if it occurs several times."""
    value = None
    for i, argument in enumerate(arguments):
        if argument == name and i + 1 < len(arguments):
            value = arguments[i + 1]
        if argument.startswith(f"{name}="):
            value = argument.split("=", 1)[1]
    return value


COMMAND = Command(
    TrainWithSettings,
    run,
    [
        "neilfpp train --data captures/teapot",
        "neilfpp train --data captures/teapot --config settings.yaml",
        "neilfpp train --data captures/teapot --host mesh --mesh scans/teapot.ply",
        "neilfpp train --data captures/teapot --budget 10m   (as many steps as fit in ten minutes)",
        "neilfpp train --data captures/teapot --view   (in the browser while it trains)",
        "neilfpp train --out runs/teapot --resume",
        "neilfpp train --data captures/teapot --effects auto,-lamps   (without lamps)",
    ],
    _starting_point,
    usual=Train,
)
