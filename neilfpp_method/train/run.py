"""A run folder: the result of a training and everything that is needed to reproduce it.

- `config.json`: all settings;
- `capture.json`: location of the capture and how it is read;
- `scene.json`: facts that were measured in the images before training;
- `environment.json`: versions, hardware, command line;
- `checkpoints/`: `last.pt`, and one checkpoint at the end of each stage;
- `previews/`: a picture per stage;
- `tensorboard/`: scalars and pictures;
- `pixels/`: pixels of the training views; it can be deleted and is created again when training continues;
- `timing.json`: seconds of each stage;
- `work.json`: seconds of each stage by kind of work (docs/budget.md);
- `quality.json`: PSNR of held-back pixels during training;
- `health.json`: findings of the health checks (docs/health.md);
- `effects.json`: the simulated effects and the reasons (docs/effects.md);
- `light.json`: evidence for lamps at each fit of the light; missing if the settings decide;
- `plan.json`: the plan of a run with `--budget`, and its revisions;
- `cache/`: surfaces that commands have extracted (`export.surface_cache`); it can be deleted;
- `skipped/`: steps that were not finite, for `neilfpp replay`; missing if there were none.
"""

from __future__ import annotations

import dataclasses
import logging
import math
import re
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Literal, TypeVar

import torch

from neilfpp_method.data.capture import Capture, Normalization, load_capture
from neilfpp_method.data.files.json_entry import write_json
from neilfpp_method.data.scaling import at_scale
from neilfpp_method.errors import UserError
from neilfpp_method.model import NeilfModel
from neilfpp_method.schedule import has_material, total_steps
from neilfpp_method.settings.facts import SceneFacts
from neilfpp_method.settings.plain import from_dict, to_dict
from neilfpp_method.settings.types import NeilfConfig, TrainConfig
from neilfpp_method.train.build import build_model
from neilfpp_method.train.checkpoint import FORMAT, LAST, checkpoint_path, load_checkpoint, load_weights
from neilfpp_method.train.effects_record import read_plan
from neilfpp_method.train.json_files import read_json
from neilfpp_method.train.lock import LOCK
from neilfpp_method.train.output import check_folder
from neilfpp_method.train.poses import corrected
from neilfpp_method.train.provenance import provenance

__all__ = [
    "BESIDE_NERFSTUDIO",
    "PIXELS",
    "CaptureSource",
    "Description",
    "Run",
    "check_free",
    "check_material",
    "create_run",
    "load_run",
    "read_description",
    "rewrite_training",
    "run_folder",
]

BESIDE_NERFSTUDIO = "neilfpp"
"""Name of the run folder that the plugin writes next to nerfstudio's `config.yml`."""
PIXELS = "pixels"
"""Folder within a run for the pixels of its training views."""
DESCRIBING_FILES = ("capture.json", "scene.json", "environment.json")
"""Files that are written before `config.json`; a folder is a run once it contains `config.json`."""
HALF_WRITTEN = re.compile(r"\.(capture|scene|environment|config)\.[0-9]+\.json")
"""Temporary names of these files while `replacing` writes them."""

log = logging.getLogger(__name__)


@dataclass(frozen=True)
class CaptureSource:
    """Location of a capture and the options with which it is read.

    Attributes:
        root: folder of the capture.
        test_every: every how many views one is held out; None for the default of the format.
        response: "linear", "srgb", or "auto" for what the files say.
        format: format of the capture; None to recognise it from the files.
        scale: size of the images relative to their files.
        unit: length of a scene unit in the world frame, which the run keeps if the scene box of the capture
            changes later; None for that of the capture.
        center: origin of the scene frame in the world frame; None together with `unit`.
    """

    root: str
    test_every: int | None = None
    response: Literal["auto", "linear", "srgb"] = "auto"
    format: str | None = None
    scale: float = 1.0
    unit: float | None = None
    center: tuple[float, float, float] | None = None

    def load(self) -> Capture:
        """Load the capture, with views of `scale` times the size of their files, in the run's scene frame."""
        capture = load_capture(Path(self.root), self.format, self.test_every, response=self.response)
        if self.unit is not None and self.center is not None:
            capture = replace(capture, normalization=Normalization(self.unit, self.center))
        return at_scale(capture, self.scale)

    def load_again(self, run: Path) -> Capture:
        """Load the capture of an existing run.

        Raises:
            UserError: if the capture has been moved or is unreadable.
        """
        if not Path(self.root).is_dir():
            raise UserError(
                f"{self.root}: the run's capture is not there",
                f"move it back, or set its new location in {run / 'capture.json'}",
            )
        return self.load()


@dataclass(frozen=True)
class Run:
    """A trained run, loaded from its folder by `load_run`.

    Attributes:
        path: the run folder.
        config: all settings of the training, with the decisions on effects applied.
        capture: the capture, with cameras in the world frame and the corrected poses of training views if
            poses were corrected (`train.poses`). `capture.normalization` converts to the scene
            frame, in which all fields of the model are defined.
        facts: facts that were measured in the images before training, such as the unit of radiance and the
            kind of background.
        model: the model in evaluation mode, with the weights after `step` steps. `model.materials(x)`,
            `model.incident_light(x, wi)` and `model.maps(rays)` take points and rays in the scene frame.
        step: number of training steps of these weights.

    Example:
        >>> run = load_run("runs/teapot")                                              # doctest: +SKIP
        >>> material = run.model.materials(run.capture.normalization.to_scene(x_world))  # doctest: +SKIP
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
        """Whether material and light have been trained; before that they have their initial values."""
        return has_material(self.step, self.config.train)

    @property
    def device(self) -> torch.device:
        """Device of the model, on which its points and rays must be."""
        return next(self.model.parameters()).device


def check_material(run: Run) -> None:
    """Check that a run has a material.

    Raises:
        UserError: if no stage has estimated it yet.
    """
    if not run.has_material:
        raise UserError(f"{run.path}: the run has no material at step {run.step}", "train the next stage")


def run_folder(path: Path) -> Path:
    """The run folder for a path: the path itself or, for nerfstudio's `config.yml`, the folder next to it.

    Raises:
        UserError: if there is no run folder next to that file.
    """
    if path.suffix != ".yml":
        return path
    folder = path.parent / BESIDE_NERFSTUDIO
    if not (folder / "config.json").is_file():
        raise UserError(
            f"{path}: no run folder {BESIDE_NERFSTUDIO}/ beside it",
            "`ns-train neilfpp` writes it with the first checkpoint, for hosts of this package "
            "(docs/nerfstudio.md)",
        )
    return folder


def check_free(path: Path) -> None:
    """Check that a new run can be created in this folder.

    Files that a training left behind when it was killed before the run existed are ignored.

    Raises:
        UserError: if the folder contains other files, or cannot be created.
    """
    check_folder(path)
    if path.exists() and any(not _is_leftover(inner.name) for inner in path.iterdir()):
        raise UserError(f"{path}: exists already", "choose another --out, or continue it with --resume")


def _is_leftover(name: str) -> bool:
    """Whether a file is left over from a training that was killed before the run existed."""
    return name in (PIXELS, LOCK, *DESCRIBING_FILES) or bool(HALF_WRITTEN.fullmatch(name))


def create_run(path: Path, config: NeilfConfig, source: CaptureSource, facts: SceneFacts) -> None:
    """Write the description of a new run into a missing or empty folder; on failure, write nothing."""
    check_free(path)
    path.mkdir(parents=True, exist_ok=True)
    description = {
        "capture.json": dataclasses.asdict(source),
        "scene.json": dataclasses.asdict(facts),
        "environment.json": provenance(),
        # The settings are written last, because a folder that contains them is a run.
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
    """Replace the stored training settings of a run, after its steps have been planned again."""
    stored = read_json(path / "config.json")
    stored["config"]["train"] = to_dict(config)
    write_json(path / "config.json", stored)


def load_run(path: Path | str, device: torch.device | str = "cpu", checkpoint: str = LAST) -> Run:
    """Load a run from its folder. A line of the log says if its training has not ended.

    Args:
        path: the run folder.
        device: device of the model.
        checkpoint: "last", or the name of a stage for the weights at its end.

    Raises:
        UserError: if the folder is not a run, or a run of another version or without this checkpoint.
    """
    path = Path(path)
    described = read_description(path)
    saved = load_checkpoint(checkpoint_path(path, checkpoint))
    capture = described.source.load_again(path)
    plan = read_plan(path, described.config, saved["step"])
    model = build_model(capture, described.facts, plan.config_of_model)
    load_weights(model, saved["model"], path)
    model.use(plan.config)
    capture = corrected(capture, model.poses)
    run = Run(path, plan.config, capture, described.facts, model.to(device).eval(), saved["step"])
    steps = total_steps(run.config.train)
    if checkpoint == LAST and run.has_material and run.step < steps:
        remedy = f"continue with: neilfpp train --out {path} --resume"
        log.warning("%s: trained for %d of %d steps; %s", path, run.step, steps, remedy)
    return run


@dataclass(frozen=True)
class Description:
    """What describes a run before its training.

    Attributes:
        config: the settings, before any decision on effects.
        source: location of the capture, and how it is read.
        facts: facts that were measured in the images.
    """

    config: NeilfConfig
    source: CaptureSource
    facts: SceneFacts


def read_description(path: Path) -> Description:
    """Read the description of a run.

    Raises:
        UserError: if the folder is not a run, a run of another version, or has a damaged file.
    """
    if not (path / "config.json").is_file():
        missing = (
            "config.json is missing" if path.is_dir() else "a file" if path.exists() else "no such folder"
        )
        raise UserError(f"{path}: no run here ({missing})", "give the folder that `neilfpp train` wrote")
    stored = read_json(path / "config.json")
    if stored.get("format") != FORMAT:
        raise UserError(
            f"{path / 'config.json'}: written in run format {stored.get('format')}, this version reads "
            f"{FORMAT}",
            "use the version of neilfpp that wrote it, or train again",
        )
    source = _parse(CaptureSource, read_json(path / "capture.json"), str(path / "capture.json"))
    _check_frame(source, path / "capture.json")
    return Description(
        _parse(NeilfConfig, stored.get("config"), f"{path / 'config.json'}: config"),
        source,
        _parse(SceneFacts, read_json(path / "scene.json"), str(path / "scene.json")),
    )


def _check_frame(source: CaptureSource, where: Path) -> None:
    """Raise a `UserError` if the scene frame is impossible: the file may have been edited by hand."""
    unit, center = source.unit, source.center
    given = unit is not None and center is not None
    if given and (not 0.0 < unit < math.inf or not all(map(math.isfinite, center))):
        raise UserError(f"{where}: unit is not positive, or center not finite", "restore the file")
    if not given and (unit, center) != (None, None):
        raise UserError(f"{where}: only one of unit and center is given", "restore the file")


Part = TypeVar("Part")


def _parse(kind: type[Part], values: Any, where: str) -> Part:
    try:
        return from_dict(kind, values, where)
    except (TypeError, AttributeError) as error:
        # A key is missing, or a value is not an object.
        raise UserError(
            f"{where}: not a complete description ({error})", "restore the file or train again"
        ) from error
