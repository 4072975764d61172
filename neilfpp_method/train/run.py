"""A run folder: everything that made a result, and the result.

config.json       every setting               environment.json  versions, hardware, command
capture.json      where the images are        timing.json       seconds of each stage
scene.json        what the images decided     checkpoints/      last.pt, and one at the end of each stage
previews/         a picture per stage         tensorboard/      scalars and pictures
pixels/           of the training views; can be deleted, and is made again when training goes on
work.json         seconds of each stage by kind of work (docs/budget.md)
quality.json      how good the run was on the way, at pixels that no step learned from
plan.json         what was planned for a budget, and how the clock changed it; not there without --budget
effects.json      which effects are simulated, and why
light.json        what spoke for lamps, fit by fit; not there where the settings had decided
skipped/          steps that were not finite, for `neilfpp replay`; not there where none was
"""

from __future__ import annotations

import dataclasses
import os
import platform
import re
import sys
from collections.abc import Mapping
from dataclasses import dataclass
from importlib import metadata
from pathlib import Path
from typing import Any, TypeVar

import torch
from torch import nn

from neilfpp_method.data.capture import Capture, load_capture
from neilfpp_method.data.images import replacing
from neilfpp_method.data.scaling import at_scale
from neilfpp_method.errors import UserError
from neilfpp_method.model import NeilfModel
from neilfpp_method.schedule import has_material
from neilfpp_method.settings.facts import SceneFacts
from neilfpp_method.settings.plain import from_dict, to_dict
from neilfpp_method.settings.types import NeilfConfig, TrainConfig
from neilfpp_method.train.build import build_model
from neilfpp_method.train.effects_record import read_plan
from neilfpp_method.train.json_files import read_json, write_json
from neilfpp_method.train.lock import LOCK

__all__ = [
    "BESIDE_NERFSTUDIO",
    "PIXELS",
    "CaptureSource",
    "Description",
    "Run",
    "check_folder",
    "check_free",
    "check_writable",
    "create_run",
    "default_folder",
    "load_checkpoint",
    "load_run",
    "load_weights",
    "read_description",
    "read_json",
    "rewrite_training",
    "run_folder",
    "save_checkpoint",
    "write_json",
]

FORMAT = 2
BESIDE_NERFSTUDIO = "neilfpp"
"""Folder beside nerfstudio's `config.yml` in which the plugin keeps a training as a run."""
PIXELS = "pixels"
"""Folder of a run in which the pixels of its training views are kept."""
DESCRIBING = ("capture.json", "scene.json", "environment.json")
"""What is written before `config.json`, which makes a folder a run."""
HALF_WRITTEN = re.compile(r"\.(capture|scene|environment|config)\.[0-9]+\.json")
"""What `replacing` calls them while they are written."""
PACKAGES = (
    "neilfpp-method",
    "torch",
    "lightning-fabric",
    "numpy",
    "opencv-contrib-python-headless",
    "OpenEXR",
    "trimesh",
    "scikit-image",
)
CHECKPOINT_KEYS = {"format", "step", "model", "light_solver", "optimizer"}


@dataclass(frozen=True)
class CaptureSource:
    """How the capture of a run is read again."""

    root: str
    test_every: int | None = None
    response: str = "auto"
    format: str | None = None
    scale: float = 1.0

    def load(self) -> Capture:
        """The capture, its views at `scale` times the size of their files."""
        return at_scale(
            load_capture(Path(self.root), self.format, self.test_every, response=self.response), self.scale
        )

    def load_again(self, run: Path) -> Capture:
        """The capture of a run that is there already.

        Raises:
            UserError: the capture has moved, or cannot be read any more.
        """
        if not Path(self.root).is_dir():
            place = run / "capture.json"
            raise UserError(
                f"{self.root}: the run's capture is not there",
                f"move it back, or give its new place in {place}",
            )
        return self.load()


@dataclass(frozen=True)
class Run:
    """A trained run, loaded from its folder by `load_run`.

    Attributes:
        path: the run folder.
        config: every setting that it was trained with, the effects as they were decided last.
        capture: the images that it was trained on, with their cameras in the world frame;
            `capture.normalisation` leads from there to the scene frame, in which all fields of the model
            live.
        facts: what the images decided before training, such as the unit of radiance and the background.
        model: in evaluation mode, with the weights of step `step`. `model.materials(x)`,
            `model.incident_light(x, wi)` and `model.maps(rays)` answer for points and rays in the scene
            frame.
        step: how many steps of training the weights have seen.

    Example:
        >>> run = load_run("runs/teapot")                                              # doctest: +SKIP
        >>> material = run.model.materials(run.capture.normalisation.to_scene(x_world))  # doctest: +SKIP
        >>> material.base_color.shape                                                    # doctest: +SKIP
        torch.Size([N, 3])
    """

    path: Path
    config: NeilfConfig
    capture: Capture
    facts: SceneFacts
    model: NeilfModel
    step: int

    @property
    def has_material(self) -> bool:
        """Whether a step has moved the material and the light; before that they are what they start as."""
        return has_material(self.step, self.config.train)


def run_folder(path: Path) -> Path:
    """The run folder that a person means: the folder itself, or the one beside nerfstudio's `config.yml`.

    Raises:
        UserError: there is none beside that file.
    """
    if path.suffix != ".yml":
        return path
    folder = path.parent / BESIDE_NERFSTUDIO
    if not (folder / "config.json").is_file():
        raise UserError(
            f"{path}: no run folder {BESIDE_NERFSTUDIO}/ beside it",
            "it is there once `ns-train neilfpp` has saved, on hosts of this package (docs/nerfstudio.md)",
        )
    return folder


def default_folder(data: Path, config: NeilfConfig) -> Path:
    """The folder of a new run without --out: runs/CAPTURE-PRESET."""
    return Path("runs") / f"{data.resolve().name}-{config.preset}"


def check_free(path: Path) -> None:
    """That a new run may take this folder.

    Raises:
        UserError: the folder is there already and holds more than a training that never began left there, or
            cannot be made.
    """
    if path.exists() and (not path.is_dir() or any(not _of_no_run(inner.name) for inner in path.iterdir())):
        raise UserError(f"{path}: exists already", "choose another --out, or continue it with --resume")
    check_folder(path)


def _of_no_run(name: str) -> bool:
    """Whether a file is left over from a training that was killed before it was a run."""
    return name in (PIXELS, LOCK, *DESCRIBING) or bool(HALF_WRITTEN.fullmatch(name))


def check_writable(path: Path) -> None:
    """Raise a UserError if a file cannot be written here. Its folder need not exist."""
    if path.is_dir():
        raise UserError(f"{path}: is a folder", "name a file with --out")
    _check_above(path, path)


def check_folder(path: Path) -> None:
    """Raise a UserError if files cannot be written into this folder. It need not exist."""
    if path.exists() and not path.is_dir():
        raise UserError(f"{path}: is a file", "name a folder with --out")
    _check_above(path / "file", path)


def _check_above(path: Path, named: Path) -> None:
    above = next(folder for folder in path.absolute().parents if folder.exists())
    if not above.is_dir() or not os.access(above, os.W_OK):
        raise UserError(
            f"{named}: cannot be written, for nothing can be made in {above}", "choose another --out"
        )


def create_run(path: Path, config: NeilfConfig, source: CaptureSource, facts: SceneFacts) -> None:
    """Write the description of a new run, whole or not at all, into a folder that is missing or empty."""
    check_free(path)
    path.mkdir(parents=True, exist_ok=True)
    description = {
        "capture.json": dataclasses.asdict(source),
        "scene.json": dataclasses.asdict(facts),
        "environment.json": environment(),
        # The settings come last: a folder that has them is a run.
        "config.json": {"format": FORMAT, "config": to_dict(config)},
    }
    try:
        for name, content in description.items():
            write_json(path / name, content)
    except UserError:
        for name in description:
            (path / name).unlink(missing_ok=True)
        raise


def rewrite_training(path: Path, config: TrainConfig) -> None:
    """The settings of the loop of a run that is there already, where its steps are planned anew."""
    stored = read_json(path / "config.json")
    stored["config"]["train"] = to_dict(config)
    write_json(path / "config.json", stored)


def load_run(path: Path | str, device: torch.device | str = "cpu", checkpoint: str = "last") -> Run:
    """A run from its folder.

    Args:
        path: the run folder.
        device: where the model goes.
        checkpoint: "last", or the name of a stage for the weights at its end.

    Raises:
        UserError: no run there, one of another version, or one without the checkpoint.
    """
    path = Path(path)
    described = read_description(path)
    saved = load_checkpoint(path / "checkpoints" / f"{checkpoint}.pt")
    capture = described.source.load_again(path)
    plan = read_plan(path, described.config, saved["step"])
    model = build_model(capture, described.facts, plan.config_of_model)
    load_weights(model, saved["model"], path)
    model.use(plan.config)
    return Run(path, plan.config, capture, described.facts, model.to(device).eval(), saved["step"])


@dataclass(frozen=True)
class Description:
    """What a run was made of."""

    config: NeilfConfig
    source: CaptureSource
    facts: SceneFacts


def read_description(path: Path) -> Description:
    """The settings, the capture's whereabouts and the scene facts of a run folder.

    Raises:
        UserError: no run there, or one of another version.
    """
    if not (path / "config.json").is_file():
        raise UserError(
            f"{path}: no run here (config.json is missing)", "give the folder that `neilfpp train` wrote"
        )
    stored = read_json(path / "config.json")
    if stored.get("format") != FORMAT:
        raise UserError(
            f"{path / 'config.json'}: written in run format {stored.get('format')}, this version reads "
            f"{FORMAT}",
            "use the version of neilfpp that wrote it, or train again",
        )
    return Description(
        _described(NeilfConfig, stored.get("config"), f"{path / 'config.json'}: config"),
        _described(CaptureSource, read_json(path / "capture.json"), str(path / "capture.json")),
        _described(SceneFacts, read_json(path / "scene.json"), str(path / "scene.json")),
    )


Part = TypeVar("Part")


def _described(kind: type[Part], values: Any, where: str) -> Part:
    try:
        return from_dict(kind, values, where)
    except (TypeError, AttributeError) as error:  # Something that must be there is missing, or is no object.
        raise UserError(
            f"{where}: not a complete description ({error})", "restore the file or train again"
        ) from error


# ------------------------------------------------------------------------------------------------ checkpoints


def save_checkpoint(
    path: Path, model: nn.Module, light_solver: nn.Module, optimizer: torch.optim.Optimizer, step: int
) -> None:
    """Weights, solver memory and optimiser after `step` steps, written atomically."""
    parts = {"model": model, "light_solver": light_solver, "optimizer": optimizer}
    contents = {"format": FORMAT, "step": step, **{name: part.state_dict() for name, part in parts.items()}}
    with replacing(path) as temporary, temporary.open("wb") as file:
        try:
            torch.save(contents, file)
        except RuntimeError as error:
            if isinstance(error.__context__, OSError):  # a full disk, of which torch tells what followed
                raise error.__context__ from None
            raise


def load_checkpoint(path: Path) -> dict[str, Any]:
    """A checkpoint's contents; a file that holds more than tensors and plain values is refused.

    Raises:
        UserError: missing, unreadable, or of another version.
    """
    if not path.is_file():
        raise UserError(f"{path}: no checkpoint", "train the run first, or continue it with --resume")
    try:
        contents = torch.load(path, map_location="cpu", weights_only=True)
    except Exception as error:  # A damaged or forged file can fail anywhere in the unpickler.
        remedy = "copy a stage's checkpoint over it, or train again"
        raise UserError(f"{path}: not a readable checkpoint", remedy) from error
    if not isinstance(contents, dict) or contents.get("format") != FORMAT or CHECKPOINT_KEYS - set(contents):
        raise UserError(
            f"{path}: a checkpoint of another version", "use the version of neilfpp that wrote it"
        )
    return contents


def load_weights(module: nn.Module, weights: Mapping[str, Any], run: Path) -> None:
    """Put weights of a checkpoint into the model, or the light solver, that the settings of its run describe.

    Raises:
        UserError: they do not fit.
    """
    try:
        module.load_state_dict(weights)
    except (RuntimeError, TypeError) as error:
        raise UserError(
            f"{run}: the checkpoint does not fit the settings in config.json",
            "restore that file, or use the version of neilfpp that wrote the run",
        ) from error


# ------------------------------------------------------------------------------------------------------ files


def environment() -> dict[str, Any]:
    """Versions and hardware, so that a figure can be traced."""
    versions = {}
    for package in PACKAGES:
        try:
            versions[package] = metadata.version(package)
        except metadata.PackageNotFoundError:
            versions[package] = "not installed as a package"
    gpus = [torch.cuda.get_device_name(i) for i in range(torch.cuda.device_count())]
    return {
        "command": sys.argv,
        "python": platform.python_version(),
        "platform": platform.platform(),
        "processor": _processor(),
        "cores": os.cpu_count(),
        "threads": torch.get_num_threads(),
        "gpus": gpus,
        "packages": versions,
    }


def _processor() -> str:
    information = Path("/proc/cpuinfo")
    if information.is_file():
        for line in information.read_text().splitlines():
            if line.startswith("model name"):
                return line.split(":", 1)[1].strip()
    return platform.processor() or platform.machine()
