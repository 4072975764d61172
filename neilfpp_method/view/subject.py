"""The run that the viewer shows: its surface, its layers, and the light selected for it."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import cached_property

import torch

from neilfpp_method.errors import UserError
from neilfpp_method.fields.environment import EnvironmentLight
from neilfpp_method.relight.lamplight import Lamplight, lamps_of_run
from neilfpp_method.relight.path_tracer import Scene
from neilfpp_method.relight.recovered import surface_of_run
from neilfpp_method.relight.sky import Sky, sky_of_run
from neilfpp_method.relight.surface import Surface
from neilfpp_method.train.run import Run
from neilfpp_method.view.confidence import ExpectedErrors, expected_errors

__all__ = ["ERROR_LAYERS", "LAYERS", "Lighting", "Subject", "own_light", "scene_of", "subject_of"]

LAYERS = {
    "pbr": "PBR",
    "radiance": "R",
    "base_color": "base colour",
    "roughness": "roughness",
    "metallic": "metallic",
    "normal": "normal",
    "base_color_error": "expected error of base colour",
    "roughness_error": "expected error of roughness",
    "metallic_error": "expected error of metallic",
}
"""Layers by name, with their titles on the page."""
ERROR_LAYERS = ("base_color_error", "roughness_error", "metallic_error")
"""Layers with the expected error of the material, in the order of the columns of `ExpectedErrors.values`."""
MATERIAL_LAYERS = {"pbr", "base_color", "roughness", "metallic", *ERROR_LAYERS}
"""Layers that need a material."""
SPECULAR_LAYERS = {"roughness_error", "metallic_error"}
"""Layers that mean nothing if surfaces are Lambertian."""


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
        missing = set() if self.run.has_material else MATERIAL_LAYERS
        if not self.run.config.shading.specular:
            missing = missing | SPECULAR_LAYERS
        return tuple(name for name in LAYERS if name not in missing)

    @cached_property
    def expected_errors(self) -> ExpectedErrors:
        """Expected errors of the material, computed when they are first asked for; needs a surface.

        Raises:
            UserError: a training view cannot be read.
        """
        assert self.surface is not None
        return expected_errors(self.run, self.surface)

    @property
    def has_expected_errors(self) -> bool:
        """Whether the expected errors have been computed."""
        return "expected_errors" in self.__dict__


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
