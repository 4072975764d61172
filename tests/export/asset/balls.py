"""A run whose surface is a sphere with known bands of paint and metal, and its asset."""

from __future__ import annotations

import dataclasses
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import torch
from rich.console import Console

from neilfpp_method.data.capture import load_capture
from neilfpp_method.export.asset.command import AssetOptions, export_asset
from neilfpp_method.model import NeilfModel
from neilfpp_method.settings.facts import SceneFacts
from neilfpp_method.settings.types import MapLightConfig
from neilfpp_method.structures import Material, RayBatch, SurfaceHits
from neilfpp_method.train.run import Run
from tests.data.make_capture import make_capture
from tests.scenes import tiny_config

RADIUS = 0.6
RIPPLES = 12.0
BULB, PANEL = [0.9, 0.0, 0.3], [-0.2, 0.8, 0.4]
INTENSITY = [[0.5, 0.25, 0.125], [0.1, 0.2, 0.4]]
AXIS = [0.0, -0.6, -0.8]


class Ball(torch.nn.Module):
    """A host that is a sphere around the origin, with ripples along z if their height is not 0."""

    def __init__(self, ripples: float = 0.0) -> None:
        super().__init__()
        self.ripples = ripples

    def render(self, rays: RayBatch) -> SurfaceHits:
        raise NotImplementedError

    def sdf(self, x: torch.Tensor) -> torch.Tensor:
        return x.norm(dim=-1) - RADIUS - self.ripples * torch.sin(RIPPLES * x[:, 2])


def material(x: torch.Tensor) -> Material:
    """A smooth material that differs at every point."""
    wave = 0.5 + 0.3 * torch.sin(3 * x)
    return Material(wave, 0.55 + 0.4 * torch.sin(2 * x[:, :1]), 0.5 + 0.4 * torch.cos(2 * x[:, 1:2]))


def ball_run(
    folder: Path,
    kind: str = "distant_near",
    step: int = 12,
    host: torch.nn.Module | None = None,
    lobe: str = "spherical_gaussian",
) -> Run:
    """An untrained run. Its light is a map of 9×18 texels, one of which is bright, and two lamps."""
    config = tiny_config()
    light = config.light if kind == "free" else MapLightConfig(kind=kind, environment_height=9)
    config = dataclasses.replace(
        config,
        light=dataclasses.replace(light, inter_reflection="off"),
        shading=dataclasses.replace(config.shading, lobe=lobe),
    )
    torch.manual_seed(0)
    model = NeilfModel(host or Ball(), config, SceneFacts("linear", 0.2, 3.0, "constant")).eval()
    model.materials = material
    if kind != "free":
        radiance = torch.full((3, 9, 18), 0.1)
        radiance[:, 3, 2] = torch.tensor([8.0, 4.0, 2.0])
        model.light.show(radiance)
    if kind == "distant_near":
        model.lamps.place(
            torch.tensor([BULB, PANEL]), torch.tensor(INTENSITY), torch.tensor([[0.0, 0.0, 0.0], AXIS])
        )
    capture = load_capture(make_capture(folder / "capture", views=8, size=(48, 36)))
    return Run(folder, config, capture, model.facts, model, step)


@contextmanager
def no_bar(title: str) -> Iterator:
    yield lambda share: None


def write_ball(
    run: Run,
    out: Path,
    size: int = 256,
    faces: int = 600,
    error: float | None = None,
    deviations=None,
    resolution: int = 48,
) -> None:
    options = AssetOptions(resolution, size, faces, error)
    export_asset(run, out, options, deviations, no_bar, Console(quiet=True))
