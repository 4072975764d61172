"""`neilfpp train`."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Literal

from neilfpp_method.commands.command import Command, Device, terminal
from neilfpp_method.errors import UserError
from neilfpp_method.settings.presets import fixed_geometry, preset
from neilfpp_method.settings.types import NeilfConfig

__all__ = ["COMMAND"]

DEFAULT_PRESET = "fast"


@dataclass
class Train:
    """Recover geometry, material and light from posed images."""

    data: Path | None = None
    """The capture's folder. Not needed with --resume."""
    out: Path | None = None
    """The run's folder; none: runs/CAPTURE-PRESET."""
    preset: str | None = None
    """fast (minutes on a laptop's CPU), paper-mlp or paper-ngp (the published settings); none: fast."""
    host: Literal["volsdf", "mesh"] = "volsdf"
    """Where geometry comes from: volsdf recovers it; mesh takes it as given and recovers material and light."""
    mesh: Path | None = None
    """The mesh of --host mesh, in the capture's world frame; none: the capture's inputs/model/mesh.ply."""
    light: Path | None = None
    """An environment map that is known (linear EXR, see docs/light.md), in the radiance of the images; none: recovered."""
    resume: bool = False
    """Continue the run in --out from its last checkpoint, exactly as if it had never stopped."""
    format: str | None = None
    """The capture's format (see docs/captures.md); none: told from what is in the folder."""
    test_every: int | None = None
    """Hold out every k-th view for testing; none: the capture's split.json, or every 8th."""
    response: Literal["auto", "linear", "srgb"] = "auto"
    """What the pixels are: linear radiance (HDR) or sRGB (LDR); auto: told from the files."""
    strict: bool = False
    """End with exit status 1 where the result is of no use: no surface, fog, nothing shaded (docs/health.md)."""
    device: Device = "auto"
    """Where to train; auto takes a GPU where there is one."""
    devices: int = 1
    """Processes that share the work, one per GPU (or CPU process)."""
    config: NeilfConfig = field(default_factory=NeilfConfig)
    """Any setting of the preset."""


def run(options: Train) -> None:
    from neilfpp_method.kernels.process import computing_fast
    from neilfpp_method.train.command import run_training

    config = _settings(options)
    as_before = options.resume and options.preset is None and config == preset(DEFAULT_PRESET)
    with computing_fast():
        run_training(
            data=options.data,
            out=options.out,
            config=None if as_before else config,
            resume=options.resume,
            test_every=options.test_every,
            response=options.response,
            format=options.format,
            device=options.device,
            devices=options.devices,
            strict=options.strict,
            console=terminal(),
        )


def _settings(options: Train) -> NeilfConfig:
    """The settings, with those that have an option of their own."""
    config = options.config
    if options.mesh is not None:
        if config.host != "mesh":
            raise UserError(f"--mesh {options.mesh}: the host {config.host} takes no mesh", "add --host mesh")
        config = replace(config, mesh=replace(config.mesh, path=str(options.mesh.resolve())))
    if options.light is not None:
        config = replace(config, light=replace(config.light, map=str(options.light.resolve())))
    return config


def _starting_point(arguments: Sequence[str]) -> Train:
    """Preset and host decide the defaults of all other settings, so they are read first."""
    config = preset(_option(arguments, "--preset") or DEFAULT_PRESET)
    return Train(config=fixed_geometry(config) if _option(arguments, "--host") == "mesh" else config)


def _option(arguments: Sequence[str], name: str) -> str | None:
    for i, argument in enumerate(arguments):
        if argument == name and i + 1 < len(arguments):
            return arguments[i + 1]
        if argument.startswith(f"{name}="):
            return argument.split("=", 1)[1]
    return None


COMMAND = Command(
    Train,
    run,
    [
        "neilfpp train --data captures/teapot",
        "neilfpp train --data captures/teapot --preset paper-ngp --out runs/teapot",
        "neilfpp train --data captures/teapot --host mesh --mesh scans/teapot.ply",
        "neilfpp train --data captures/teapot --light studio.exr",
        "neilfpp train --out runs/teapot --resume",
        "neilfpp train --data captures/teapot --config.train.joint-steps 0   (the separate pipeline)",
        "neilfpp train --data captures/teapot --config.inter-reflection.mode off",
    ],
    _starting_point,
)
