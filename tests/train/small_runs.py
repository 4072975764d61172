"""Small trainings with milliseconds per step, for tests of the loop."""

from __future__ import annotations

import dataclasses
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import pytest
import torch
from lightning_fabric import Fabric
from rich.console import Console

from neilfpp_method.data.capture import load_capture
from neilfpp_method.data.pixels.dataset import PixelDataset
from neilfpp_method.data.pixels.held_back import PATCHES, hold_back
from neilfpp_method.effects.plan import Plan
from neilfpp_method.effects.request import EffectRequest
from neilfpp_method.health.watch import Watch
from neilfpp_method.lighting import solver
from neilfpp_method.settings.presets import preset
from neilfpp_method.settings.types import NeilfConfig
from neilfpp_method.train.build import build_model, scene_facts
from neilfpp_method.train.optimizer import seed_step
from neilfpp_method.train.progress import Reporter
from neilfpp_method.train.quality import Quality
from neilfpp_method.train.training import Training
from tests.scenes import tiny_config

FIT_STEPS = 5
"""Optimisation steps of a light fit in `short_light_fits`."""


def small_config(**train) -> NeilfConfig:
    """The tiny settings, in which most rays with any weight are shaded, with four steps per stage unless
    `train` changes it.
    """
    config = tiny_config()
    return dataclasses.replace(
        config,
        shading=dataclasses.replace(config.shading, hit_share=0.2),
        train=dataclasses.replace(config.train, **train),
    )


def few_steps() -> NeilfConfig:
    """These settings with six steps in all."""
    return small_config(sdf_steps=2, material_steps=3, joint_steps=1)


def solved_light(config: NeilfConfig) -> NeilfConfig:
    """The settings with the light of `fast`: a small map and lamps, fitted at every third step, and traced
    visibility.
    """
    fast = preset("fast")
    fit = dataclasses.replace(fast.light.fit, points=32, every=3)
    return dataclasses.replace(
        config,
        light=dataclasses.replace(fast.light, environment_height=4, fit=fit),
    )


@contextmanager
def short_light_fits() -> Iterator[None]:
    """Light fits with few steps, for tests of the training and of what follows it, not of the light.

    Fits of the usual length take most of the time of a small training, and amplify rounding.
    """
    with pytest.MonkeyPatch.context() as patch:
        for name in ("STEPS", "START_STEPS"):
            patch.setattr(solver, name, FIT_STEPS)
        yield


class Listener(Reporter):
    """A reporter that prints nothing and records its calls."""

    def __init__(self) -> None:
        super().__init__(Console(quiet=True), None, None)
        self.said: list[str] = []
        self.losses: list[float] = []

    def step(self, loss: float, psnr: float) -> None:
        self.losses.append(loss)

    def warn(self, text: str) -> None:
        self.said.append(text)


def small_training(root: Path, out: Path, config: NeilfConfig, patches: int = PATCHES) -> Training:
    """A training of a capture that is ready to start, with so many held-back patches."""
    capture = load_capture(root)
    pixels = PixelDataset(capture, capture.train_views)
    seed_step(config.train.seed, step=-1)
    model = build_model(capture, scene_facts(capture, pixels, config), config)
    listener = Listener()
    return Training(
        path=out,
        config=config,
        model=model,
        pixels=pixels,
        fabric=Fabric(accelerator="cpu", devices=1),
        reporter=listener,
        should_stop=lambda: False,
        preview=lambda model, capture, stage: None,
        continue_with="",
        light_solver=model.light_solver(),
        watch=Watch(pixels.sample(64), listener.warn, listener.say),
        plan=Plan.begin(EffectRequest("as-set"), config),
        quality=Quality(hold_back(pixels, config.train.seed, patches)),
    )


def differences(one: object, other: object, where: str = "") -> list[str]:
    """The places at which two nested structures of dictionaries, lists and tensors differ in any bit."""
    if isinstance(one, torch.Tensor) and isinstance(other, torch.Tensor):
        same = one.dtype == other.dtype and torch.equal(one, other)
    elif isinstance(one, dict) and isinstance(other, dict) and one.keys() == other.keys():
        return [place for key in one for place in differences(one[key], other[key], f"{where}.{key}")]
    elif isinstance(one, list | tuple) and isinstance(other, list | tuple) and len(one) == len(other):
        return [place for i in range(len(one)) for place in differences(one[i], other[i], f"{where}.{i}")]
    else:
        same = one == other
    return [] if same else [where]
