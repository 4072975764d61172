"""What is looked at: a run with its surface, the layers that it has, and the light that is chosen for it."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import torch

from neilfpp_method.errors import UserError
from neilfpp_method.fields.environment import EnvironmentLight
from neilfpp_method.relight.lamplight import Lamplight, lamps_of_run
from neilfpp_method.relight.path_tracer import Scene
from neilfpp_method.relight.recovered import surface_of_run
from neilfpp_method.relight.sky import Sky, sky_of_run
from neilfpp_method.relight.surface import Surface
from neilfpp_method.train.run import Run

__all__ = ["LAYERS", "Lighting", "Subject", "own_light", "scene_of", "subject_of"]

LAYERS = {
    "pbr": "PBR",
    "radiance": "R",
    "base_color": "base colour",
    "roughness": "roughness",
    "metallic": "metallic",
    "normal": "normal",
}
"""Names of layers, and how they are called on the screen."""
OF_MATERIAL = {"pbr", "base_color", "roughness", "metallic"}


@dataclass(frozen=True)
class Subject:
    """A run to look at.

    Attributes:
        run: with its model in evaluation mode.
        surface: where rays of all layers but R end; none: the run has no surface.
        note: what is missing and why, in a sentence for people; empty where nothing is.
    """

    run: Run
    surface: Surface | None
    note: str

    @property
    def device(self) -> torch.device:
        """Where it is computed."""
        return next(self.run.model.parameters()).device

    @property
    def layers(self) -> tuple[str, ...]:
        """Those that can be shown."""
        if self.surface is None:
            return ("radiance",)
        return tuple(name for name in LAYERS if self.run.has_material or name not in OF_MATERIAL)


@dataclass(frozen=True)
class Lighting:
    """The chosen light. `own`: the run's own, unchanged. No sky: light that is free at every point."""

    sky: Sky | None
    lamps: Lamplight | None
    own: bool = True

    def turned(self, degrees: float) -> Lighting:
        """With the sky turned about +z, counter-clockwise seen from above."""
        if self.sky is None or degrees == 0:
            return self
        return replace(self, sky=replace(self.sky, start=self.sky.start - math.radians(degrees)), own=False)

    def with_lamps(self, lamps: Lamplight | None) -> Lighting:
        """With lamps elsewhere, or without."""
        return replace(self, lamps=lamps, own=False)


def subject_of(run: Run, resolution: int) -> Subject:
    """A run as it can be shown.

    Args:
        run: as loaded.
        resolution: cells along an edge of the scene's cube, where the surface is extracted from a distance
            field.
    """
    try:
        surface, note = surface_of_run(run, resolution), ""
    except UserError as error:
        surface, note = None, f"There is no surface yet, so R alone can be shown: {error.problem}."
    if surface is not None and not run.has_material:
        note = f"There is no material at step {run.step}: train the next stage."
    return Subject(run, surface, note)


def own_light(run: Run) -> Lighting:
    """The light that a run has found."""
    light = run.model.light
    if not isinstance(light, EnvironmentLight):
        return Lighting(None, None)
    return Lighting(sky_of_run(light), lamps_of_run(run.model.lamps))


@torch.no_grad()
def scene_of(subject: Subject, light: Lighting) -> Scene:
    """What paths are traced through; asks for a surface and a sky."""
    assert subject.surface is not None
    assert light.sky is not None
    model = subject.run.model
    return Scene(subject.surface, model.materials, model.lobe, light.sky, light.lamps)
