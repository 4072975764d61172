"""`neilfpp train`."""

from __future__ import annotations

import os
from contextlib import AbstractContextManager, nullcontext
from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated, Literal

import tyro

from neilfpp_method.commands.command import Command, Device, terminal
from neilfpp_method.commands.report import after_training
from neilfpp_method.commands.train_settings import DEFAULT_PRESET, base_settings, with_files
from neilfpp_method.settings.presets import preset
from neilfpp_method.settings.types import NeilfConfig

__all__ = ["COMMAND"]


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
    config = with_files(options.config, options.mesh, options.light)
    named = options.preset is not None or options.config_file is not None
    as_before = options.resume and not named and config == preset(DEFAULT_PRESET)
    if options.resume and options.effects is None:
        effects = None
    else:
        published = config.preset.startswith("paper-")
        effects = parse_effects(options.effects or ("as-set" if published else "auto"))
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
    lambda words: TrainWithSettings(config=base_settings(words)),
    usual=Train,
)
