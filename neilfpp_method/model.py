"""NeILF++: material and light on top of a host that provides geometry and outgoing radiance.

`NeilfModel.step` is one training step. It reads from top to bottom in the order of the paper's §4.2.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import replace

import torch
from jaxtyping import Float
from torch import Tensor, nn

from neilfpp_method import losses
from neilfpp_method.fields import (
    BrdfField,
    LightModel,
    NormalTilts,
    PhotographGains,
    PoseCorrections,
    at_mean_exposure,
    make_light,
    tilted,
)
from neilfpp_method.hosts.base import HasParameterGroups, HasStages, Host, Regularized, SmoothsNormals
from neilfpp_method.hosts.outputs import OutputCheck
from neilfpp_method.incident import Sources, arriving, incident_radiance, scene_tracer, trace_light
from neilfpp_method.lighting.solver import LightSolver, make_light_solver
from neilfpp_method.schedule import BORROWED_HOST, STAGES, Stage, StagePlan, StageTable, active_losses
from neilfpp_method.settings.check import check_config
from neilfpp_method.settings.facts import SceneFacts, radiance_units
from neilfpp_method.settings.types import NeilfConfig, ShadingConfig
from neilfpp_method.shading import LOBES, Lobe, Sampling, initial_albedo, sample_directions, shade
from neilfpp_method.structures import (
    Incident,
    LossTerm,
    LossTerms,
    Maps,
    Material,
    PixelBatch,
    RayBatch,
    SceneTracer,
    Shading,
    StepResult,
    SurfaceHits,
    SurfacePixels,
)
from neilfpp_method.timing.ledger import timed

__all__ = ["EVAL_RAYS", "NeilfModel"]

EVAL_RAYS = 2048
"""Largest number of rays in one call of `NeilfModel.maps`; their incident directions must fit in memory."""
CLEAR_OPACITY = 0.01
"""Opacity below which a ray counts as missing the scene: its pixel shows what lies behind, and no material.
"""
SURFACE_OPACITY = 0.5
"""Opacity above which `maps` shades a ray. Edges that mix two surfaces count, too: images have no holes. A
pixel that shows mostly what lies behind the surface keeps the colour of the host.
"""


class NeilfModel(nn.Module):
    """The method on top of any host: fields B and L, the rendering equation, and the losses of a step.

    Args:
        host: renders rays (`hosts.base.Host`). If it has `parameter_groups`, its parameters are trained
            together with the model's own.
        config: the settings.
        facts: what was measured on the images before training.
        borrowed: whether the host belongs to another trainer. If so, it is not a submodule: its parameters,
            device and train/eval mode are left alone. Gradients still reach it in the joint stage.

    Attributes:
        host: geometry G and outgoing radiance R.
        brdf: B, the material at every point.
        tilts: corrections of the normals for shading; None if surfaces are shaded with those of the host.
        light, lamps: L, the light that arrives at unoccluded points, and the small lamps near the scene.
        gains: gain of each photograph relative to the mean; None if all are assumed to have one exposure.
        poses: corrections of the training cameras; None if their poses are as given. The model gets rays of
            corrected cameras, it only keeps the corrections for checkpoints.
        lobe: distribution of the specular reflection; None for Lambertian surfaces.
        stages: stage table for this kind of host: active losses and trained fields of each stage.
        units: units in which the losses measure radiance.
        check_outputs: rejects host outputs that break the contract.
        observers: callbacks that get the batch and the host's hits of every training step, before shading.

    Raises:
        UserError: a setting is out of range (`settings.check`).
    """

    def __init__(self, host: Host, config: NeilfConfig, facts: SceneFacts, borrowed: bool = False) -> None:
        super().__init__()
        check_config(config)
        if borrowed:
            # Bypass nn.Module, which would register the host as a submodule.
            object.__setattr__(self, "host", host)
        else:
            self.host = host
        self.facts, self.borrowed = facts, borrowed
        self.units = radiance_units(config, facts)
        self.stages = _stage_table(host, borrowed)
        self.check_outputs = OutputCheck(host, config.shading.hit_share, may_be_constant=borrowed)
        self.observers: list[Callable[[PixelBatch, SurfaceHits], None]] = []
        self.brdf = BrdfField(config.brdf, config.encoding, config.background.radius)
        refines = config.shading.normals == "refined" and isinstance(host, SmoothsNormals)
        self.tilts = NormalTilts() if refines else None
        has_gains = config.optimizer.exposure > 0 and len(facts.log_gains) > 0
        self.gains = PhotographGains(torch.tensor(facts.log_gains).view(-1, 3)) if has_gains else None
        self.poses: PoseCorrections | None = None
        # The light starts at the radiance under which the initial material has the images' median radiance.
        albedo = initial_albedo(
            config.brdf.initial_base_color, config.brdf.initial_metallic, _specular_lobe(config.shading)
        )
        parts = make_light(config, facts.response, facts.median_radiance / albedo)
        self.light, self.lamps = parts.light, parts.lamps
        self.use(config)

    def use(self, config: NeilfConfig) -> None:
        """Switch to other settings. Effects may change; the sizes of the fields must not."""
        self.config = config
        self.lobe = _specular_lobe(config.shading)
        self.brdf.use(config.brdf)
        LightModel(self.light, self.lamps).use(config.light)

    @contextmanager
    def evaluating(self) -> Iterator[None]:
        """Evaluation mode within the context."""
        mode = self.training
        self.eval()
        try:
            yield
        finally:
            self.train(mode)

    # ----------------------------------------------------------------------------------------------- one step

    def forward(self, batch: PixelBatch, stage: Stage, hits: SurfaceHits | None = None) -> StepResult:
        """Alias of `step`: the wrappers of data-parallel training call `forward`."""
        return self.step(batch, stage, hits)

    def losses(self, batch: PixelBatch, stage: Stage, hits: SurfaceHits | None = None) -> LossTerms:
        """Only the loss terms of `step`, before their weights."""
        return self.step(batch, stage, hits).terms

    def step(self, batch: PixelBatch, stage: Stage, hits: SurfaceHits | None = None) -> StepResult:
        """Compute the active losses of a stage for a batch of pixels, in the six steps of the paper's §4.2.

        Args:
            batch: training pixels with their camera rays.
            stage: the stage of training; it determines the active losses and which fields get gradients.
                Steps 2 to 6 are skipped in a stage that does not train material and light.
            hits: what the host rendered for this batch; if None, the host is rendered here.

        Returns:
            The loss terms, and the surface and background pixels from which the light is solved.
        """
        plan, active = self.stages[stage], active_losses(stage, self.config, self.stages)
        if not active:
            return StepResult.of({}, SurfacePixels.empty_like(batch), batch[:0])

        # 1. Geometry G and outgoing radiance R: render colour, hit position and normal of each camera ray.
        hits, terms = self._render_host(batch, plan, active, hits)
        if "volume" in active:
            terms |= self._volume_losses(batch, hits)
        if not plan.trains_material:
            return StepResult.of(terms, SurfacePixels.empty_like(batch), batch[:0])

        # 2. Surface points: rays on the object that hit a single surface.
        batch = self._at_mean_exposure(batch)
        is_surface = hits.is_hit(self.config.shading.hit_share) & (batch.mask > 0.5)
        rows = torch.nonzero(is_surface)[:, 0]
        surface = self._surface_pixels(hits[rows], batch[rows])
        position, normal, wo = surface.position, surface.normal, surface.wo

        # 3. Material: query the BRDF field B at the surface points.
        material, priors = self._material_and_priors(surface, active)
        terms |= priors

        # 4. Incident light L: sample directions wi, for a solved light in two independent halves.
        parts = 1 if self.config.light.kind == "free" else 2
        count = max(1, self.config.shading.train_samples // parts)
        halves = [self._incident(position, normal, wo, material, count) for _ in range(parts)]

        # 5. Rendering equation: outgoing radiance towards wo by each half, compared with the pixel.
        with timed("shading"):
            colors = [shade(material, normal, wo, half, self.lobe).color for half in halves]
        terms["physical"] = losses.physical(
            colors[0], colors[-1], surface.pixel, self.facts.response, self.units.physical
        )

        # 6. Inter-reflection: where a ray along wi hits the scene again, L here must equal R there.
        if "inter_reflection" in active:
            terms["inter_reflection"] = self._inter_reflection(position, normal)
        return StepResult.of(terms, surface, self._background_pixels(batch, hits))

    @timed("rendering")
    def _render_host(
        self, batch: PixelBatch, plan: StagePlan, active: Mapping[str, float], hits: SurfaceHits | None
    ) -> tuple[SurfaceHits, dict[str, LossTerm]]:
        """Hits and the host's own active losses; without gradients if the stage does not train the host."""
        with torch.set_grad_enabled(torch.is_grad_enabled() and plan.trains_host):
            if hits is not None:
                hits, terms = hits if torch.is_grad_enabled() else hits.detach(), {}
            elif isinstance(self.host, Regularized):
                regularized = self.host.render_regularized(batch, active)
                hits, terms = regularized.hits, dict(regularized.terms)
            else:
                hits, terms = self.host.render(batch.rays), {}
            self.check_outputs(batch.rays, hits, trains_color="volume" in active and torch.is_grad_enabled())
        if self.training:
            for observe in self.observers:
                observe(batch, hits)
        return hits, terms

    def _volume_losses(self, batch: PixelBatch, hits: SurfaceHits) -> dict[str, LossTerm]:
        """L_vol of the host's colour and, if photographs have gains of their own, the prior on the gains."""
        terms, color = {}, hits.color
        if self.gains is not None:
            terms["exposure"] = losses.exposure(self.gains.drift())
            color = color * self.gains(batch.view)
        terms["volume"] = losses.photometric(color, batch.color, self.facts.response, self.units.volume)
        return terms

    def _at_mean_exposure(self, batch: PixelBatch) -> PixelBatch:
        """Bring pixels to the mean exposure. Gains are constants here: L_vol, on all pixels, trains them."""
        color = at_mean_exposure(self.gains, batch.color, batch.view, self.facts.response)
        return replace(batch, color=color)

    @timed("shading")
    def _surface_pixels(self, hits: SurfaceHits, pixels: PixelBatch) -> SurfacePixels:
        """Surface points to shade; gradients to the host's position and normal are scaled by the settings."""
        settings = self.config.loss
        hit_normal = losses.scale_gradient(hits.normal, settings.normal_gradient)
        return SurfacePixels(
            position=losses.scale_gradient(hits.position, settings.position_gradient),
            normal=self.shading_normals(hits.position, hit_normal),
            wo=-pixels.directions,
            pixel=pixels.color,
            image_gradient=pixels.image_gradient,
        )

    @timed("shading")
    def _material_and_priors(
        self, surface: SurfacePixels, active: Mapping[str, float]
    ) -> tuple[Material, dict[str, LossTerm]]:
        """The material of surface points, and the active priors on it and on the tilts of normals."""
        priors = {}
        if "smoothness" in active:
            with timed("regularizers"):
                sample = self.brdf.with_gradients(surface.position)
            material = sample.material
            priors["smoothness"] = losses.smoothness(
                sample.roughness_gradient, sample.metallic_gradient, surface.image_gradient
            )
        else:
            material = self.brdf(surface.position)
        if "lambertian" in active:
            priors["lambertian"] = losses.lambertian(material)
        if self.tilts is not None:
            priors["tilt"] = losses.tilt(self.tilts(surface.position))
        return material, priors

    @timed("shading")
    def _incident(
        self,
        position: Float[Tensor, "N 3"],
        normal: Float[Tensor, "N 3"],
        wo: Float[Tensor, "N 3"],
        material: Material,
        samples: int,
    ) -> Incident:
        """Incident light along `samples` directions per point; no gradient flows through their choice."""
        sampling = Sampling(self.config.shading.sampler, samples, self.lobe, stochastic=self.training)
        n = normal.detach()
        drawn = sample_directions(sampling, n, wo, material.detach(), self.light.technique(n))
        return arriving(self.sources, position, drawn)

    @timed("tracing")
    def _inter_reflection(self, position: Float[Tensor, "P 3"], normal: Float[Tensor, "P 3"]) -> LossTerm:
        """L_ref on random rays from surface points, at those that hit the scene."""
        traced = trace_light(self.host, position, normal, self.config)
        rows = torch.nonzero(traced.hit)[:, 0]
        incident = self.light.radiance(traced.position[rows], traced.wi[rows][:, None])[:, 0]
        return losses.inter_reflection(
            incident, traced.radiance[rows], self.units.incident, self.config.light.monochrome
        )

    def _background_pixels(self, batch: PixelBatch, hits: SurfaceHits) -> PixelBatch:
        """Pixels that a mask does not assign to the object and whose rays miss the scene."""
        off_object = (batch.mask < 0.5) | (batch.mask_known == 0)
        return batch[torch.nonzero(off_object & (hits.opacity.detach() < CLEAR_OPACITY))[:, 0]]

    # ---------------------------------------------------------------------------------------------- the parts

    @property
    def scene(self) -> SceneTracer | None:
        """Traces light between surfaces of the scene; None unless inter-reflection is hard."""
        if self.config.light.inter_reflection != "hard":
            return None
        return scene_tracer(self.host, self.config.ray_offset, self.config.shading.hit_share)

    @property
    def sources(self) -> Sources:
        """Everything that sends light to a surface point: light, lamps, and the scene itself."""
        return Sources(self.light, self.lamps, self.scene)

    def light_solver(self) -> LightSolver:
        """Make a new solver for this model's light; training loops call it (`lighting.solver`)."""
        light = LightModel(self.light, self.lamps)
        return make_light_solver(self.config.light, self.facts, self.units, light, self.lobe)

    def materials(self, x: Float[Tensor, "N 3"]) -> Material:
        """Base colour, roughness and metallic at points of the scene frame."""
        return self.brdf(x)

    def shading_normals(
        self, position: Float[Tensor, "N 3"], normal: Float[Tensor, "N 3"]
    ) -> Float[Tensor, "N 3"]:
        """Unit normals for shading, refined if the settings say so, with the gradient of `normal`."""
        if self.tilts is None:
            return normal
        smooth = self.host.smooth_normals(position.detach(), normal.detach())
        return tilted(smooth, self.tilts(position)) + (normal - normal.detach())

    def incident_light(self, x: Float[Tensor, "N 3"], wi: Float[Tensor, "N S 3"]) -> Float[Tensor, "N S 3"]:
        """Linear radiance at x from wi: of the light, the lamps, or a surface that occludes them."""
        return incident_radiance(self.sources, x, wi)

    @timed("shading")
    def shade(
        self,
        position: Float[Tensor, "N 3"],
        normal: Float[Tensor, "N 3"],
        wo: Float[Tensor, "N 3"],
        material: Material,
        samples: int,
    ) -> Shading:
        """Outgoing radiance towards wo by the rendering equation, from `samples` directions per point."""
        incident = self._incident(position, normal, wo, material, samples)
        return shade(material, normal, wo, incident, self.lobe)

    @torch.no_grad()
    def host_maps(self, rays: RayBatch) -> Maps:
        """Render the maps that need neither material nor light: `rgb` is the host's colour, material is 0."""
        return Maps.of_host(rays, self.host.render(rays))

    @torch.no_grad()
    def maps(self, rays: RayBatch, hits: SurfaceHits | None = None) -> Maps:
        """Render all maps of rays, for images and metrics. Split large images: memory grows with the rays.

        Args:
            rays: rays in the scene frame.
            hits: what the host rendered for these rays; if None, the host is rendered here.
        """
        hits = self.host.render(rays) if hits is None else hits.detach()
        maps = Maps.of_host(rays, hits)
        rows = torch.nonzero(hits.opacity > CLEAR_OPACITY)[:, 0]
        if not len(rows):
            return maps
        position, wo = hits.position[rows], -rays.directions[rows]
        normal, material = self.shading_normals(position, hits.normal[rows]), self.brdf(position)
        maps = maps.with_rows(rows, normal=normal, **vars(material))
        solid = torch.nonzero(hits.opacity[rows] > SURFACE_OPACITY)[:, 0]
        samples = self.config.shading.eval_samples
        shading = self.shade(position[solid], normal[solid], wo[solid], material[solid], samples)
        parts = {"rgb": shading.color, "diffuse": shading.diffuse, "specular": shading.specular}
        return maps.with_rows(rows[solid], **parts)

    # --------------------------------------------------------------------------------------------- parameters

    def parameter_groups(self) -> dict[str, list[nn.Parameter]]:
        """Parameters by field: the model's own and, unless borrowed, those that the host offers."""
        trains_host = isinstance(self.host, HasParameterGroups) and not self.borrowed
        host = self.host.parameter_groups() if trains_host else {}
        own = {"brdf": list(self.brdf.parameters()), "light": list(self.light.parameters())}
        if self.tilts is not None:
            own["brdf"] += self.tilts.parameters()
        if self.gains is not None:
            own["exposure"] = list(self.gains.parameters())
        return {**host, **own}

    def freeze_for(self, stage: Stage) -> None:
        """Set `requires_grad` of exactly the fields that a stage trains, and clear all gradients."""
        for name, parameters in self.parameter_groups().items():
            for parameter in parameters:
                parameter.requires_grad_(name in self.stages[stage].trains)
                parameter.grad = None


def _stage_table(host: Host, borrowed: bool) -> StageTable:
    if isinstance(host, HasStages):
        return host.stages
    return BORROWED_HOST if borrowed else STAGES


def _specular_lobe(shading: ShadingConfig) -> Lobe | None:
    return LOBES[shading.lobe] if shading.specular else None
