"""The light solver: it remembers what training steps showed, and solves for the light behind it.

    solver = model.light_solver()
    step = model.step(batch, stage)
    solver.observe(step)
    evidence = solver.solve(model.brdf, model.scene)

A light that is free at every point is learned by gradients; `NothingToSolve` stands in its place.
"""

from __future__ import annotations

from typing import Protocol, runtime_checkable

import torch
from torch import nn

from neilfpp_method.fields.brdf import BrdfField
from neilfpp_method.fields.light import LightModel
from neilfpp_method.lighting.fit import Evidence
from neilfpp_method.lighting.memory import SurfaceMemory
from neilfpp_method.lighting.objective import Objective
from neilfpp_method.lighting.sky import SkySightings
from neilfpp_method.lighting.solve import solve_light
from neilfpp_method.settings.facts import RadianceUnits, SceneFacts
from neilfpp_method.settings.types import FreeLightConfig, MapLightConfig
from neilfpp_method.shading.brdf import Lobe
from neilfpp_method.structures import Material, Observed, SceneTracer, StepResult

__all__ = ["LightSolver", "MapSolver", "NothingToSolve", "make_light_solver"]


@runtime_checkable
class LightSolver(Protocol):
    """What a training loop calls after every step; a module, as checkpoints hold what it remembers."""

    @property
    def due(self) -> bool:
        """Whether `solve` would solve now."""
        ...

    @property
    def points(self) -> int:
        """How many surface points are remembered."""
        ...

    def observe(self, step: StepResult) -> None:
        """Remember what a training step showed of the surface and of the light beyond it."""
        ...

    def use(self, config: FreeLightConfig | MapLightConfig, lobe: Lobe | None) -> None:
        """Solve with these settings, and for surfaces of this lobe, from now on; what is remembered stays."""
        ...

    @property
    def seeks_start(self) -> bool:
        """Whether a map is sought, and nothing is known of it yet."""
        ...

    def start(self, observed: Observed, material: Material, scene: SceneTracer | None) -> Evidence | None:
        """Seek lamps before the map that has been set; without any it stays as it is. Surfaces learn under it
        for a while before the first `solve`.

        Args:
            observed, material: surface points, and what they are made of.
            scene: as of `solve`.

        Returns:
            As of `solve`.
        """
        ...

    def solve(self, brdf: BrdfField, scene: SceneTracer | None) -> Evidence | None:
        """Set the light to what explains the remembered points, when it is time.

        Args:
            brdf: says what the remembered points are made of.
            scene: stands between the points and the light, and shines on them; none where nothing is traced.

        Returns:
            What the points that were kept back say of lamps; none where nothing was solved, or the settings
            had decided.
        """
        ...


class NothingToSolve(nn.Module):
    """The solver of a light that is learned by gradients, or known."""

    due, points, seeks_start = False, 0, False

    def start(self, observed: Observed, material: Material, scene: SceneTracer | None) -> None:
        """Nothing is solved for."""

    def observe(self, step: StepResult) -> None:
        """Nothing is remembered."""

    def use(self, config: FreeLightConfig | MapLightConfig, lobe: Lobe | None) -> None:
        """Nothing depends on the settings."""

    def solve(self, brdf: BrdfField, scene: SceneTracer | None) -> None:
        """Nothing is solved for."""


class MapSolver(nn.Module):
    """Solves for an environment map and the lamps before it.

    Args:
        config: of the light.
        facts, units: of the scene.
        light: the map and the lamps that are set; they stay those of the model.
        lobe: of the specular reflection; none for Lambertian surfaces.
    """

    def __init__(
        self,
        config: MapLightConfig,
        facts: SceneFacts,
        units: RadianceUnits,
        light: LightModel,
        lobe: Lobe | None,
    ) -> None:
        super().__init__()
        self.config, self.response, self.unit = config, facts.response, units.physical
        self.light, self.lobe = light, lobe
        self.memory = SurfaceMemory(config.fit.points, config.fit.every)
        # Only a background that is no backdrop shows the light, and only an unknown map must match it.
        sightings = config.map is None and facts.background == "inverted_sphere"
        rows = light.light.log_radiance.shape[1]
        self.sky = SkySightings(rows, facts.response) if sightings else None

    @property
    def due(self) -> bool:
        """Whether `solve` would solve now."""
        return self.memory.due and not _is_given(self.config)

    @property
    def points(self) -> int:
        """How many surface points are remembered."""
        return self.memory.points.filled

    def observe(self, step: StepResult) -> None:
        """As of `LightSolver`."""
        if not len(step.surface_rows) and not len(step.beyond_rows):
            return
        self.memory.remember(step.surface)
        if self.sky is not None:
            self.sky.remember(*step.beyond_rows.split(3, -1))

    @property
    def seeks_start(self) -> bool:
        """As of `LightSolver`."""
        sought = self.config.map is None and not self.light.light.even
        return sought and self.memory.age is None and self.points == 0

    @torch.no_grad()
    def start(self, observed: Observed, material: Material, scene: SceneTracer | None) -> Evidence | None:
        """As of `LightSolver`."""
        self.memory.wait()
        if self.config.kind == "distant":
            return None
        before, rows = self.light.light.log_radiance.clone(), slice(self.config.fit.points)
        measured = self._solve(observed[rows], material[rows], scene, first=True, benefit_of_doubt=True)
        if not self.light.lamps.lit:
            self.light.light.log_radiance.copy_(before)
        return measured

    def use(self, config: MapLightConfig, lobe: Lobe | None) -> None:
        """As of `LightSolver`."""
        self.config, self.lobe = config, lobe

    @torch.no_grad()
    def solve(self, brdf: BrdfField, scene: SceneTracer | None) -> Evidence | None:
        """As of `LightSolver`."""
        if not self.due:
            return None
        first, observed = self.memory.age is None, self.memory.recall()
        return self._solve(observed, brdf(observed.position), scene, first)

    def _solve(
        self,
        observed: Observed,
        material: Material,
        scene: SceneTracer | None,
        first: bool,
        benefit_of_doubt: bool = False,
    ) -> Evidence | None:
        sky = None if self.sky is None else self.sky.known()
        environment = self.light.light
        objective = Objective(
            self.response,
            self.unit,
            self.config.fit,
            None if environment.even else sky,
            self.config.monochrome,
        )
        found = solve_light(
            self.light,
            observed,
            material,
            self.lobe,
            scene,
            objective,
            self.config,
            first,
            benefit_of_doubt,
        )
        if environment.even:
            environment.log_radiance.copy_(environment.log_radiance[:, :1, :1].clone())
        return found


def make_light_solver(
    config: FreeLightConfig | MapLightConfig,
    facts: SceneFacts,
    units: RadianceUnits,
    light: LightModel,
    lobe: Lobe | None,
) -> MapSolver | NothingToSolve:
    """The solver that a light needs; arguments as of `MapSolver`."""
    if isinstance(config, FreeLightConfig) or _is_given(config):
        return NothingToSolve()
    return MapSolver(config, facts, units, light, lobe)


def _is_given(config: MapLightConfig) -> bool:
    """Whether the map is known and nothing is sought before it."""
    return config.map is not None and config.kind == "distant"
