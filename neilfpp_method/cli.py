"""The command line: `neilfpp COMMAND …`. Each command is a dataclass of options and a function that runs it."""

from __future__ import annotations

import io
import os
import sys
from collections.abc import Callable, Sequence
from contextlib import redirect_stderr
from dataclasses import dataclass, field, replace
from itertools import takewhile
from pathlib import Path
from typing import Annotated, Any, Literal

import tyro
from rich.console import Console
from rich.progress import BarColumn, Progress, TextColumn, TimeRemainingColumn

from neilfpp_method.config import NeilfConfig
from neilfpp_method.errors import EarlyEnd, Stopped, UserError
from neilfpp_method.prepare.options import Prepare
from neilfpp_method.presets import fixed_geometry, preset

__all__ = ["main"]

DEFAULT_PRESET = "fast"
Device = Annotated[str, tyro.conf.arg(metavar="cpu|cuda|cuda:N|auto")]


# -------------------------------------------------------------------------------------------------------------- options


@dataclass
class Inspect:
    """Say what is in a capture and what is wrong with it."""

    data: tyro.conf.Positional[Path]
    """The capture's folder."""
    out: Path | None = None
    """Where inspect.json and inspect.png go; none: they are not written."""
    format: str | None = None
    """The capture's format; none: told from what is in the folder."""
    response: Literal["auto", "linear", "srgb"] = "auto"
    """What the pixels are: linear radiance (HDR) or sRGB (LDR); auto: told from the files."""
    strict: bool = False
    """End with status 1 where there is a problem."""


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
    device: Device = "auto"
    """Where to train; auto takes a GPU where there is one."""
    devices: int = 1
    """Processes that share the work, one per GPU (or CPU process)."""
    config: NeilfConfig = field(default_factory=NeilfConfig)
    """Any setting of the preset."""


@dataclass
class Eval:
    """Measure a run on its test views; writes RUN/metrics.json."""

    run: tyro.conf.Positional[Path]
    """The run's folder."""
    checkpoint: Literal["last", "sdf_init", "material_init", "joint"] = "last"
    """Which weights."""
    out: Path | None = None
    """Where the figures go; none: RUN/metrics.json."""
    device: Device = "auto"
    """Where to compute."""


@dataclass
class Render:
    """Write every map of a run's views as PNG and EXR, and a picture of the light that arrives at four points."""

    run: tyro.conf.Positional[Path]
    """The run's folder."""
    out: Path | None = None
    """Where the pictures go; none: RUN/renders."""
    what: tuple[Literal["maps", "light"], ...] = ("maps", "light")
    """maps: a folder each, and an EXR a view. light: incident_light.png, beside the truth where that is at hand."""
    views: Literal["test", "train", "all"] = "test"
    """Which views."""
    checkpoint: Literal["last", "sdf_init", "material_init", "joint"] = "last"
    """Which weights."""
    overwrite: bool = False
    """Render again what is there already."""
    confidence: bool = False
    """Add maps of how far off base colour, roughness and metallic may be (base_color_std, …); takes about twice as long."""
    device: Device = "auto"
    """Where to compute."""


@dataclass
class Export:
    """Write a run's surface and its light for other programs, in the capture's frame and scale."""

    run: tyro.conf.Positional[Path]
    """The run's folder."""
    what: tuple[Literal["mesh", "light"], ...] = ()
    """mesh: the surface (PLY). light: environment map (EXR), lamps (JSON), probes (EXR). None named: what the run has."""
    out: Path | None = None
    """The folder; none: RUN/export."""
    resolution: int = 256
    """Cells of the mesh along an edge of the scene's cube."""
    probes: int | None = None
    """Light probes, spread over the surface; none: 16 for a light that is free at every point, else 0."""
    checkpoint: Literal["last", "sdf_init", "material_init", "joint"] = "last"
    """Which weights."""
    device: Device = "auto"
    """Where to compute."""


@dataclass
class Demo:
    """Train on the scene in the package and write a report to look at."""

    out: Path = Path("demo-run")
    """Where the run and its report go."""
    resume: bool = False
    """Continue a demo that was stopped."""
    short: bool = False
    """A twentieth of the steps: shows that everything runs, not what it can do."""
    device: Device = "auto"
    """Where to compute."""


# ------------------------------------------------------------------------------------------------------------- commands


def run_inspect(options: Inspect) -> None:
    from neilfpp_method.inspection.command import run_inspection

    run_inspection(options.data, options.out, options.format, options.response, options.strict, Console())


def run_prepare(options: Prepare) -> None:
    from neilfpp_method.prepare.command import run_prepare as prepare

    prepare(options, Console())


def run_train(options: Train) -> None:
    from neilfpp_method.train.command import run_training

    config = options.config
    if options.mesh is not None:
        if config.host != "mesh":
            raise UserError(f"--mesh {options.mesh}: the host {config.host} takes no mesh", "add --host mesh")
        config = replace(config, mesh=replace(config.mesh, path=str(options.mesh.resolve())))
    if options.light is not None:
        config = replace(config, light=replace(config.light, map=str(options.light.resolve())))
    as_before = options.resume and options.preset is None and config == preset(DEFAULT_PRESET)
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
        console=Console(),
    )


def run_eval(options: Eval) -> None:
    from neilfpp_method.evaluate.protocols import evaluate, write_metrics
    from neilfpp_method.train.device import pick_device
    from neilfpp_method.train.run import load_run

    run = load_run(options.run, pick_device(options.device), options.checkpoint)
    out = options.out or options.run / "metrics.json"
    with _bar("evaluating") as advance:
        metrics = evaluate(run, advance)
    write_metrics(out, run, metrics)
    console = Console()
    for name, value in metrics.items():
        console.print(f"{name:36} {value:8.3f}", highlight=False)
    console.print(f"written to {out}", highlight=False)


def run_render(options: Render) -> None:
    from neilfpp_method.evaluate.render_views import render_run
    from neilfpp_method.evaluate.report import write_light_picture
    from neilfpp_method.train.device import pick_device
    from neilfpp_method.train.run import load_run

    run = load_run(options.run, pick_device(options.device), options.checkpoint)
    out = options.out or options.run / "renders"
    if "maps" in options.what:
        with _bar("rendering") as advance:
            render_run(run, out, options.views, options.overwrite, options.confidence, advance)
    if "light" in options.what and not write_light_picture(run, out / "incident_light.png") and options.what == ("light",):
        raise UserError(f"{options.run}: there is no light to show at step {run.step}", "train the next stage")
    Console().print(f"written to {out}", highlight=False)


def run_export(options: Export) -> None:
    from neilfpp_method.export.command import run_export as export

    export(**vars(options), console=Console())


def run_demo(options: Demo) -> None:
    from neilfpp_method.demo import run_demo as demo

    demo(options.out, short=options.short, resume=options.resume, device=options.device, console=Console())


class _bar:
    """A progress bar that takes shares of the work done."""

    def __init__(self, title: str) -> None:
        share = TextColumn("{task.percentage:3.0f} %")
        self.progress = Progress(TextColumn(title), BarColumn(), share, TimeRemainingColumn())
        self.task = self.progress.add_task(title, total=1.0)

    def __enter__(self) -> Callable[[float], None]:
        self.progress.start()
        return lambda share: self.progress.update(self.task, completed=share)

    def __exit__(self, *_: object) -> None:
        self.progress.stop()


@dataclass(frozen=True)
class Command:
    """A command: its options, what runs it, and examples for its help."""

    options: type
    run: Callable[[Any], None]
    examples: Sequence[str]

    @property
    def summary(self) -> str:
        return (self.options.__doc__ or "").strip()


COMMANDS = {
    "demo": Command(Demo, run_demo, ["neilfpp demo", "neilfpp demo --short --out trial"]),
    "inspect": Command(
        Inspect,
        run_inspect,
        ["neilfpp inspect captures/teapot", "neilfpp inspect captures/teapot --out teapot-inspection --strict"],
    ),
    "prepare": Command(
        Prepare,
        run_prepare,
        [
            "neilfpp prepare photos/teapot --out captures/teapot",
            "neilfpp prepare photos/teapot --out captures/teapot --dense --also nerfstudio neilf",
            "neilfpp prepare scans/colmap-project --out captures/teapot   (keeps the poses)",
        ],
    ),
    "train": Command(
        Train,
        run_train,
        [
            "neilfpp train --data captures/teapot",
            "neilfpp train --data captures/teapot --preset paper-ngp --out runs/teapot",
            "neilfpp train --data captures/teapot --host mesh --mesh scans/teapot.ply",
            "neilfpp train --data captures/teapot --light studio.exr",
            "neilfpp train --out runs/teapot --resume",
            "neilfpp train --data captures/teapot --config.train.joint-steps 0   (the separate pipeline)",
            "neilfpp train --data captures/teapot --config.inter-reflection.mode off",
        ],
    ),
    "eval": Command(
        Eval,
        run_eval,
        ["neilfpp eval runs/teapot", "neilfpp eval runs/teapot --checkpoint material_init --out sep.json"],
    ),
    "render": Command(
        Render,
        run_render,
        ["neilfpp render runs/teapot", "neilfpp render runs/teapot --views all", "neilfpp render runs/teapot --what light"],
    ),
    "export": Command(
        Export,
        run_export,
        ["neilfpp export runs/teapot --resolution 512", "neilfpp export runs/teapot --what light --probes 32 --out teapot"],
    ),
}


def main(arguments: Sequence[str] | None = None) -> int:
    """Run a command and return the exit status: 0 done, 2 bad input, 130 stopped, 1 anything else."""
    arguments = list(sys.argv[1:] if arguments is None else arguments)
    if not arguments or arguments[0] in ("-h", "--help"):
        print(_overview())
        return 0
    # Beside the first process of a parallel run the others keep silent, and leave the status to it.
    first = os.environ.get("LOCAL_RANK", "0") == "0"
    errors = Console(stderr=True, quiet=not first)
    name, rest = arguments[0], arguments[1:]
    try:
        if name == "--version":
            from neilfpp_method import __version__

            print(f"neilfpp {__version__}")
            return 0
        if name not in COMMANDS:
            raise UserError(f"unknown command '{name}'", f"choose one of {', '.join(COMMANDS)}")
        command = COMMANDS[name]
        command.run(_parse(name, command, rest))
    except EarlyEnd as end:
        text = str(end) if isinstance(end, Stopped) else f"error: {end}"
        errors.print(text, highlight=False, soft_wrap=True, markup=False)
        return end.status if first else 0
    except SystemExit:  # tyro has shown a command's help
        return 0
    except KeyboardInterrupt:
        errors.print("stopped")
        return Stopped.status
    return 0


def _parse(name: str, command: Command, arguments: Sequence[str]) -> Any:
    description = f"{command.summary}\n\nExamples:\n" + "\n".join(f"  {example}" for example in command.examples)
    defaults = {}
    if command.options is Train:
        # Preset and host decide the defaults of all other settings, so they are read first.
        start = _starting_point(_option(arguments, "--preset"), _option(arguments, "--host"))
        defaults = {"default": Train(config=start)}
    known = {"args": arguments, "prog": f"neilfpp {name}", "description": description, **defaults}
    complaint = io.StringIO()
    try:
        with redirect_stderr(complaint):
            return tyro.cli(command.options, **known)
    except SystemExit as end:
        if not complaint.getvalue():  # --help
            raise
        raise UserError(_first_paragraph(complaint.getvalue()), f"see neilfpp {name} --help") from end


def _starting_point(name: str | None, host: str | None) -> NeilfConfig:
    """The settings of a preset for a host."""
    config = preset(name or DEFAULT_PRESET)
    return fixed_geometry(config) if host == "mesh" else config


def _first_paragraph(boxed: str) -> str:
    """What a complaint says first, as one line, without the box around it."""
    lines = [line.strip("│ ") for line in boxed.splitlines() if line.startswith("│")] or boxed.split("\n")
    return " ".join(takewhile(lambda line: line.strip("─"), lines)).rstrip(".")


def _option(arguments: Sequence[str], name: str) -> str | None:
    for i, argument in enumerate(arguments):
        if argument == name and i + 1 < len(arguments):
            return arguments[i + 1]
        if argument.startswith(f"{name}="):
            return argument.split("=", 1)[1]
    return None


def _overview() -> str:
    lines = [
        "neilfpp: geometry, material and light from posed images",
        "",
        "usage: neilfpp COMMAND [options]        neilfpp COMMAND --help",
        "",
        *(f"  {name:8} {command.summary}" for name, command in COMMANDS.items()),
        "",
        "examples:",
        "  neilfpp demo",
        "  neilfpp train --data captures/teapot --out runs/teapot",
        "  neilfpp eval runs/teapot",
    ]
    return "\n".join(lines)


if __name__ == "__main__":
    sys.exit(main())
