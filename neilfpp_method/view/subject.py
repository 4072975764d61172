"""The run that the viewer shows: its surface, its layers, and the light selected for it."""

from __future__ import annotations

import math
from collections.abc import Callable
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
"""Layers by name, with their titles on the page."""
MATERIAL_LAYERS = {"pbr", "base_color", "roughness", "metallic"}
"""Layers that need a material."""


@dataclass(frozen=True)
class Subject:
    """A run to view.

    Attributes:
        run: the run, with its model in evaluation mode.
        surface: the surface that all layers except R show; None if the run has no surface.
        note: a sentence for the user on what is missing and why; empty if nothing is missing.
    """

    run: Run
    surface: Surface | None
    note: str

    @property
    def device(self) -> torch.device:
        """Device of the model."""
        return self.run.device

    @property
    def layers(self) -> tuple[str, ...]:
        """Names of the layers that can be shown."""
        if self.surface is None:
            return ("radiance",)
        return tuple(name for name in LAYERS if self.run.has_material or name not in MATERIAL_LAYERS)


@dataclass(frozen=True)
class Lighting:
    """The selected light.

    Attributes:
        sky: the environment map; None if the run has a free light, which cannot be changed.
        lamps: the lamps, or None.
        own: whether this is the run's own light, unchanged.
    """

    sky: Sky | None
    lamps: Lamplight | None
    own: bool = True

    def turned(self, degrees: float) -> Lighting:
        """Rotate the sky around +z, counter-clockwise seen from above."""
        if self.sky is None or degrees == 0:
            return self
        return replace(self, sky=replace(self.sky, start=self.sky.start - math.radians(degrees)), own=False)

    def with_lamps(self, lamps: Lamplight | None) -> Lighting:
        """Replace the lamps, or remove them with None."""
        return replace(self, lamps=lamps, own=False)


def subject_of(
    run: Run, resolution: int, say: Callable[[str], None] = lambda text: None, keep: bool = True
) -> Subject:
    """Prepare a run for viewing.

    Args:
        run: the run.
        resolution: number of cells along an edge of the scene's cube when a surface is extracted from a
            distance field.
        say: receives a message if a file in the run folder is replaced.
        keep: whether an extracted surface is kept in the run folder.
    """
    try:
        surface, note = surface_of_run(run, resolution, say, keep), ""
    except UserError as error:
        surface, note = None, f"Only R can be shown: {error.problem}; {error.remedy}."
    if surface is not None and not run.has_material:
        note = f"There is no material at step {run.step}: train the next stage."
    return Subject(run, surface, note)


def own_light(run: Run) -> Lighting:
    """The estimated light of a run."""
    light = run.model.light
    if not isinstance(light, EnvironmentLight):
        return Lighting(None, None)
    return Lighting(sky_of_run(light), lamps_of_run(run.model.lamps))


@torch.no_grad()
def scene_of(subject: Subject, light: Lighting) -> Scene:
    """Build the scene of the path tracer. The subject must have a surface, and the light a sky."""
    assert subject.surface is not None
    assert light.sky is not None
    model = subject.run.model
    return Scene(subject.surface, model.materials, model.lobe, light.sky, light.lamps)
