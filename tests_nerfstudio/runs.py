"""Small scenes, and trainings of them by `ns-train` in this process."""

from __future__ import annotations

import copy
import dataclasses
import json
from pathlib import Path
from typing import Any

import numpy as np
import torch
from nerfstudio.configs.method_configs import all_methods
from nerfstudio.engine.trainer import TrainerConfig
from nerfstudio.scripts import train

from neilfpp_method.data.files.images import read_image, write_exr
from neilfpp_method.demo.command import demo_scene
from neilfpp_method.schedule import stage_steps
from neilfpp_method.settings.plain import changed
from neilfpp_method.settings.presets import preset
from neilfpp_method.settings.types import LightFitConfig, NeilfConfig
from tests.train.small_runs import small_config

REDUCTION = 5
TRAIN, TEST = (0, 5, 10, 15, 20, 25, 30, 35), (4, 29)


def reduced_tabletop(root: Path) -> Path:
    """The demo table top at a fifth of its size: eight training views and two test views."""
    scene = json.loads((demo_scene() / "inputs" / "sfm_scene.json").read_text())
    tracks, files = scene["camera_track_map"]["images"], scene["image_path"]["file_paths"]
    kept = [str(i) for i in (*TRAIN, *TEST)]
    scene["camera_track_map"]["images"] = {key: tracks[key] for key in kept}
    scene["image_path"]["file_paths"] = {key: files[key] for key in kept}
    for key in kept:
        camera, (width, height) = tracks[key]["camera"]["intrinsic"], tracks[key]["size"]
        tracks[key]["size"] = [width // REDUCTION, height // REDUCTION]
        for name in ("focal", "ppt"):
            camera[name] = (np.array(camera[name]) / REDUCTION).tolist()
        pixels = read_image(demo_scene() / "inputs" / files[key]).pixels
        blocks = pixels.reshape(height // REDUCTION, REDUCTION, width // REDUCTION, REDUCTION, 3)
        write_exr(root / "inputs" / files[key], {"RGB": blocks.mean(axis=(1, 3))})
    (root / "inputs" / "sfm_scene.json").write_text(json.dumps(scene))
    (root / "split.json").write_text(json.dumps({"test": list(TEST)}))
    return root


def small_settings(**steps: int) -> NeilfConfig:
    """The tiny settings with the light of the preset, fitted at every third step, and four steps per stage
    unless `steps` changes it. Photographs have one exposure.
    """
    usual = preset("fast")
    config = changed(small_config(**steps), {"host.volume.beta_final": usual.host.volume.beta_final})
    fit = LightFitConfig(points=48, every=3)
    return dataclasses.replace(
        config,
        light=dataclasses.replace(usual.light, environment_height=8, fit=fit),
        optimizer=dataclasses.replace(config.optimizer, exposure=0.0),
    )


def trainer_config(
    data: Path,
    out: Path,
    settings: NeilfConfig,
    host: str | None = None,
    method: str = "neilfpp",
    effects: str = "as-set",
) -> TrainerConfig:
    """The configuration that `ns-train neilfpp --data … --pipeline.model.host …` is parsed to."""
    config = copy.deepcopy(all_methods[method])
    model, pixels = config.pipeline.model, config.pipeline.datamanager
    model.neilf, model.host, model.effects = settings, host, effects
    pixels.train_num_rays_per_batch = pixels.eval_num_rays_per_batch = settings.train.rays
    config.machine.device_type, config.vis = "cpu", "tensorboard"
    config.max_num_iterations = sum(stage_steps(settings.train).values())
    config.data, config.output_dir = data, out
    return config


def ns_train(config: TrainerConfig) -> Path:
    """Train in this process; returns the folder of the run."""
    config.viewer.quit_on_train_completion = True
    train.main(config)
    return config.get_base_dir()


def checkpoint(run: Path) -> dict:
    """The last checkpoint of a run, which contains only tensors and plain values."""
    path = sorted((run / "nerfstudio_models").glob("*.ckpt"))[-1]
    return torch.load(path, map_location="cpu", weights_only=True)


def weights(run: Path) -> dict[str, Any]:
    """The state of a run with the names of `NeilfModel`."""
    prefix = "_model.neilf."
    return {
        key.removeprefix(prefix): t
        for key, t in checkpoint(run)["pipeline"].items()
        if key.startswith(prefix)
    }


def with_steps(settings: NeilfConfig, **steps: int) -> NeilfConfig:
    """The same settings with other numbers of steps."""
    return dataclasses.replace(settings, train=dataclasses.replace(settings.train, **steps))
