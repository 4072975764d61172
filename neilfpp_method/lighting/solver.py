"""The light solver remembers surface points of training steps and periodically fits the light to them.

    solver = model.light_solver()
    step = model.step(batch, stage)
    solver.observe(step)
    evidence = solver.solve(model.brdf, model.scene)

The free light field is learned by gradient descent instead; its solver, `NothingToSolve`, does nothing.
"""

from __future__ import annotations

import copy
import dataclasses
import math
from collections.abc import Callable
from typing import Protocol, runtime_checkable

import torch
from torch import nn

from neilfpp_method.fields.brdf import BrdfField
from neilfpp_method.fields.lamps import Lamps
from neilfpp_method.fields.light import LightModel
from neilfpp_method.lighting.fit import Evidence
from neilfpp_method.lighting.fit_points import FitPoints
from neilfpp_method.lighting.memory import SurfaceMemory
from neilfpp_method.lighting.objective import DARK_FLOOR, STEPS, Objective
from neilfpp_method.lighting.sky import SkySightings
from neilfpp_method.lighting.solve import refit_light, solve_light
from neilfpp_method.settings.facts import RadianceUnits, SceneFacts
from neilfpp_method.settings.types import FreeLightConfig, MapLightConfig
from neilfpp_method.shading.brdf import Lobe
from neilfpp_method.structures import Material, Observed, SceneTracer, StepResult

__all__ = ["JudgeLamps", "LightSolver", "MapSolver", "NothingToSolve", "make_light_solver"]


JudgeLamps = Callable[[Lamps, Lobe | None, SceneTracer | None], Evidence]
"""Measures the benefit of lamps by other data than the points at which they were found."""
START_ROWS = 16
"""Rows of the map while lamps are sought beside an initial map. The five comparisons then take seconds: these
are a ninth of the texels of preset `fast`.
"""
START_STEPS = 300
"""Steps of these fits, which start without lamps. After 100 steps the gain by lamps on recovered geometry
varied from −0.1 to 2.9 % between random candidates, in a scene with lamps; after 300 from 1.9 to 3.7 %. In
two scenes without lamps it is below 0.3 %.
"""


@runtime_checkable
class LightSolver(Protocol):
    """The interface that a training loop calls after every step.

    Implementations are modules, because the remembered points are part of a checkpoint.
    """

    @property
    def due(self) -> bool:
        """Whether `solve` would run a fit now."""
        ...

    @property
    def points(self) -> int:
        """Number of remembered surface points."""
        ...

    def observe(self, step: StepResult) -> None:
        """Remember the surface points of a training step, and its pixels that show the light directly."""
        ...

    def use(self, config: FreeLightConfig | MapLightConfig, lobe: Lobe | None) -> None:
        """Use other settings and another specular lobe from now on; the remembered points are kept."""
        ...

    @property
    def seeks_start(self) -> bool:
        """Whether the solver fits a map and there has been neither a fit nor a start."""
        ...

    @property
    def scale_is_free(self) -> bool:
        """Whether the scale between light and base colour is that of an initial light, which may be off."""
        ...

    def rescale(self, factor: float) -> None:
        """Divide the light by a factor; the base colours of later fits are brighter by it."""
        ...

    def start(
        self, observed: Observed, material: Material, scene: SceneTracer | None, judge: JudgeLamps
    ) -> Evidence | None:
        """Look for lamps in addition to an initial map that has been set; if none is found, keep that map.

        The first `solve` is due one interval of fits later, so that surfaces first learn under this light.
        Later fits neither look for lamps nor move them, which saves most of their time: their points are
        fewer, and show one view each. Surfaces that have hardly learned misplaced a lamp by 0.3 scene units,
        and surfaces that have learned with a light confirm it.

        Args:
            observed: surface points.
            material: their material. The mean logarithm of the base colour is that of all later fits: light
                and base colour share a scale that the fits hardly determine, and that would drift.
            scene: as in `solve`.
            judge: compares the lamps with none. They are rejected if they are worse by more than one standard
                error.

        Returns:
            As in `solve`; the result of `judge` if that rejected the lamps.
        """
        ...

    def solve(self, brdf: BrdfField, scene: SceneTracer | None) -> Evidence | None:
        """If a fit is due, set the light to the one that best explains the remembered points.

        Args:
            brdf: gives the material of the points.
            scene: traces rays from the points through the scene, which blocks light and emits its own
                radiance; None without traced visibility.

        Returns:
            The comparison of a light with lamps and one without at held-back points; None if no fit was due
            or the settings decide about lamps.
        """
        ...


class NothingToSolve(nn.Module):
    """The solver of a light that is learned by gradient descent, or completely known: it does nothing."""

    due, points, seeks_start, scale_is_free = False, 0, False, False

    def rescale(self, factor: float) -> None:
        """Do nothing."""

    def start(
        self, observed: Observed, material: Material, scene: SceneTracer | None, judge: JudgeLamps
    ) -> None:
        """Do nothing."""

    def observe(self, step: StepResult) -> None:
        """Do nothing."""

    def use(self, config: FreeLightConfig | MapLightConfig, lobe: Lobe | None) -> None:
        """Do nothing."""

    def solve(self, brdf: BrdfField, scene: SceneTracer | None) -> None:
        """Do nothing."""


class MapSolver(nn.Module):
    """The solver of an environment map and near lamps.

    Args:
        config: settings of the light.
        facts: facts of the scene: the response, and the kind of background.
        units: units of radiance in which errors are measured.
        light: the map and the lamps of the model, which the solver changes in place.
        lobe: the specular lobe; None for Lambertian surfaces.
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
        # Infinite without an initial light: the current base colour then determines the scale.
        self.register_buffer("log_mean_base_color", torch.tensor(torch.inf))
        # Whether the initial light, which many more pixels support than a later fit, is better without lamps.
        self.register_buffer("lamps_rejected", torch.tensor(False))
        self.memory = SurfaceMemory(config.fit.points, config.fit.every)
        # The light is only visible behind the scene if the background is open, and a known map needs no
        # observation.
        sightings = config.map is None and facts.background == "inverted_sphere"
        rows = light.light.log_radiance.shape[1]
        self.sky = SkySightings(rows, facts.response) if sightings else None

    @property
    def due(self) -> bool:
        """See `LightSolver.due`."""
        return self.memory.due and not _is_given(self.config)

    @property
    def points(self) -> int:
        """See `LightSolver.points`."""
        return self.memory.points.filled

    def observe(self, step: StepResult) -> None:
        """See `LightSolver.observe`."""
        if not len(step.surface_rows) and not len(step.background_rows):
            return
        self.memory.remember(step.surface)
        if self.sky is not None:
            self.sky.remember(*step.background_rows.split(3, -1))

    @property
    def seeks_start(self) -> bool:
        """See `LightSolver.seeks_start`."""
        fits_map = self.config.map is None and not self.light.light.even
        return fits_map and self.memory.age is None and not self._has_initial_light

    @property
    def scale_is_free(self) -> bool:
        """See `LightSolver.scale_is_free`."""
        fixed_by_sky = self.sky is not None and not self.light.light.even and self.sky.known().fixes_scale
        return self._has_initial_light and self.config.map is None and not fixed_by_sky

    @torch.no_grad()
    def rescale(self, factor: float) -> None:
        """See `LightSolver.rescale`."""
        self.light.light.log_radiance.sub_(math.log(factor))
        self.light.lamps.intensity.div_(factor)
        self.log_mean_base_color.add_(math.log(factor))

    @torch.no_grad()
    def start(
        self, observed: Observed, material: Material, scene: SceneTracer | None, judge: JudgeLamps
    ) -> Evidence | None:
        """See `LightSolver.start`."""
        self.log_mean_base_color.copy_(material.base_color.log().mean())
        if self.config.kind == "distant":
            self.memory.wait()
            return None
        environment, lamps = self.light.light, self.light.lamps
        # What cameras saw of the light is stored for the texels of the full map.
        coarse = environment.at_most(START_ROWS) if self.sky is None else environment
        trial = LightModel(copy.deepcopy(coarse), lamps)
        measured = self._solve(trial, observed, material, scene, first=True, at_start=True)
        if lamps.count and measured is not None:
            in_views = judge(lamps, self.lobe, scene)
            if in_views.gain < -in_views.deviation:
                lamps.switch_off()
                measured = in_views
        if lamps.count:
            environment.resample(trial.light.log_radiance)
        self.memory.wait()
        self.lamps_rejected.fill_(not lamps.count)
        return measured

    def use(self, config: MapLightConfig, lobe: Lobe | None) -> None:
        """See `LightSolver.use`."""
        self.config, self.lobe = config, lobe

    @torch.no_grad()
    def solve(self, brdf: BrdfField, scene: SceneTracer | None) -> Evidence | None:
        """See `LightSolver.solve`."""
        if not self.due:
            return None
        first, observed = self.memory.age is None, self.memory.recall()
        return self._solve(self.light, observed, brdf(observed.position), scene, first)

    @property
    def _has_initial_light(self) -> bool:
        """Whether `start` was called."""
        return bool(self.log_mean_base_color.isfinite())

    def _log_scale(self, material: Material) -> float:
        """Logarithm of the factor that gives base colours the mean of the initial light."""
        log_mean = material.base_color.clamp_min(DARK_FLOOR).log().mean()
        log_scale = (self.log_mean_base_color - log_mean).item()
        return log_scale if math.isfinite(log_scale) else 0.0

    def _solve(
        self,
        light: LightModel,
        observed: Observed,
        material: Material,
        scene: SceneTracer | None,
        first: bool,
        at_start: bool = False,
    ) -> Evidence | None:
        environment = light.light
        sky = None if self.sky is None or environment.even else self.sky.known()
        objective = Objective(
            self.response,
            self.unit,
            sky=sky,
            monochrome=self.config.monochrome,
            steps=START_STEPS if at_start else STEPS,
            log_scale=None if sky is not None and sky.fixes_scale else self._log_scale(material),
        )
        points, config = FitPoints(observed, material, self.lobe, scene), self.config
        if self.lamps_rejected and config.kind == "auto":
            config = dataclasses.replace(config, kind="distant")
        measured = None
        if light.lamps.count and self._has_initial_light and not at_start:
            refit_light(light, points, objective, config)
        else:
            measured = solve_light(light, points, objective, config, first, lamps_if_undecided=at_start)
        if environment.even:
            environment.log_radiance.copy_(environment.log_radiance[:, :1, :1].clone())
        return measured


def make_light_solver(
    config: FreeLightConfig | MapLightConfig,
    facts: SceneFacts,
    units: RadianceUnits,
    light: LightModel,
    lobe: Lobe | None,
) -> MapSolver | NothingToSolve:
    """Make the solver for a light; the arguments are those of `MapSolver`."""
    if isinstance(config, FreeLightConfig) or _is_given(config):
        return NothingToSolve()
    return MapSolver(config, facts, units, light, lobe)


def _is_given(config: MapLightConfig) -> bool:
    """Whether the map is known and no lamps are fitted."""
    return config.map is not None and config.kind == "distant"
