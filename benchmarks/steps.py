"""Whole training steps of every stage and preset, rendering for evaluation, and the memory that a step takes.

The scene is the one in the package; the surface is the sphere that every geometry starts as, made sharp, so
that the material stages have hits to shade. Numbers of rays are small; networks and samples per ray and per
point are the presets' own.
"""

from __future__ import annotations

import multiprocessing
from collections.abc import Callable, Iterator
from concurrent.futures import ProcessPoolExecutor
from functools import cache
from pathlib import Path

from benchmarks.measure import Measurement, device, in_yardsticks
from neilfpp_method.data.capture import load_capture
from neilfpp_method.data.pixels.dataset import PixelDataset
from neilfpp_method.demo.command import demo_scene
from neilfpp_method.model import NeilfModel
from neilfpp_method.schedule import Stage, active_losses, weigh
from neilfpp_method.settings.plain import changed
from neilfpp_method.settings.presets import PRESETS, preset
from neilfpp_method.settings.types import NeilfConfig
from neilfpp_method.structures import PixelBatch
from neilfpp_method.train.build import build_model, scene_facts
from neilfpp_method.train.optimizer import Stream, make_optimizer, seed_step, seed_stream

__all__ = ["measurements", "model_of", "pixels_of", "step_of"]

RAYS = 64
EVALUATED = 256  # rays
REPETITIONS = 3
PROCESS = Path("/proc/self")
SHARP = 3e-3  # β of a surface that counts as trained, scene units


def config_of(name: str) -> NeilfConfig:
    """A preset for the scene of the package, which has no point cloud, with a surface that can be shaded."""
    changes = {"host.loss.point_cloud": 0.0, "host.volume.beta_init": SHARP, "train.rays": RAYS}
    return changed(preset(name), changes)


@cache
def _pixels() -> PixelDataset:
    capture = load_capture(demo_scene())
    return PixelDataset(capture, capture.train_views, device=device())


def model_of(name: str) -> NeilfModel:
    """The untrained model of a preset."""
    config, pixels = config_of(name), _pixels()
    seed_stream(config.train.seed, Stream.WEIGHTS)
    return build_model(pixels.capture, scene_facts(pixels.capture, pixels, config), config).to(device())


def pixels_of(rays: int) -> PixelBatch:
    """So many pixels, the same in every call, so that steps can be compared."""
    seed_step(0, 0)
    return _pixels().sample(rays)


def step_of(model: NeilfModel, stage: Stage, rays: int = RAYS) -> Callable[[], None]:
    """A training step as in the loop, always on the same pixels, so that steps can be compared."""
    config = model.config
    weights = active_losses(stage, config, model.stages)
    optimizer = make_optimizer(model, config.optimizer)
    for group in optimizer.param_groups:
        group["lr"] = 0.0  # the surface stays where it is, step by step
    batch = pixels_of(rays)

    def step() -> None:
        seed_step(0, 1)
        model.freeze_for(stage)
        total = weigh(model.losses(batch, stage), weights)
        optimizer.zero_grad(set_to_none=True)
        total.loss.backward()
        optimizer.step()

    return step


def peak_mebibytes(name: str) -> float:
    """Peak memory that a joint step of a model adds to the process, MiB. Only Linux reports it."""
    step = step_of(model_of(name), Stage.JOINT)
    (PROCESS / "clear_refs").write_text("5")  # the peak so far is forgotten
    before = _resident("VmRSS")
    step()
    return _resident("VmHWM") - before


def _resident(name: str) -> float:
    """A figure of this process's memory, MiB."""
    lines = (PROCESS / "status").read_text().splitlines()
    return next(int(line.split()[1]) for line in lines if line.startswith(f"{name}:")) / 1024


def measurements() -> Iterator[Measurement]:
    """Steps in yardsticks, pixels per yardstick, and memory."""
    for name in PRESETS:
        model = model_of(name)
        for stage in Stage:
            step = step_of(model, stage)
            taken = in_yardsticks(step, REPETITIONS)
            yield Measurement(f"step/{name}/{stage.value}", taken, "yardsticks", "lower", tolerance=0.5)
        model.eval()
        rays = _pixels().sample(EVALUATED).rays
        taken = in_yardsticks(lambda model=model, rays=rays: model.maps(rays), REPETITIONS)
        yield Measurement(
            f"evaluation/{name}", EVALUATED / taken, "pixels a yardstick", "higher", tolerance=0.5
        )
    spawn = multiprocessing.get_context(
        "spawn"
    )  # a process of its own: none of its memory has been used before
    for name in PRESETS if (PROCESS / "clear_refs").exists() else ():
        with ProcessPoolExecutor(1, mp_context=spawn) as fresh:
            peak = fresh.submit(peak_mebibytes, name).result()
        yield Measurement(f"memory/{name}/joint", peak, "MiB", "lower", tolerance=0.3)
