"""NeILF++: a host that knows geometry and radiance, and the material and the light that explain what it sees.

One training step reads top to bottom in `NeilfModel.step`, in the order of the paper's §4.2.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from dataclasses import replace

import torch
from jaxtyping import Float
from torch import Tensor, nn

from neilfpp_method import losses
from neilfpp_method.fields.brdf import BrdfField
from neilfpp_method.fields.environment import EnvironmentLight
from neilfpp_method.fields.exposure import PhotographGains, at_mean_exposure
from neilfpp_method.fields.light import LightModel, make_light
from neilfpp_method.hosts.base import HasParameterGroups, HasStages, Host, Regularised, SmoothsNormals
from neilfpp_method.hosts.outputs import OutputCheck
from neilfpp_method.incident import (
    Sources,
    arriving,
    draw_directions,
    incident_radiance,
    scene_tracer,
    trace_light,
)
from neilfpp_method.lighting.replay import Replay
from neilfpp_method.lighting.solver import LightSolver, make_light_solver
from neilfpp_method.schedule import BORROWED_HOST, STAGES, Stage, StagePlan, active_losses
from neilfpp_method.settings.check import check_config
from neilfpp_method.settings.facts import SceneFacts, radiance_units
from neilfpp_method.settings.types import NeilfConfig, ShadingConfig
from neilfpp_method.shading import LOBES, Lobe, initial_albedo, shade
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
from neilfpp_method.timing.ledger import doing

__all__ = ["NeilfModel"]

CLEAR_OPACITY = 0.01
"""Opacity below which a ray shows what lies beyond the scene."""
SURFACE_OPACITY = 0.5
"""Opacity above which a picture shows a surface, also where a pixel mixes two: a picture has no holes."""


class NeilfModel(nn.Module):
    """The method on top of any host.

    Args:
        host: renders rays (`hosts.base.Host`); its parameters train with ours where it offers
            `parameter_groups`.
        config: the settings.
        facts: what the images decided.
        borrowed: the host belongs to another trainer. Its parameters, its device and its mode are then none
            of this module's, though gradients reach it in the joint stage.

    Attributes:
        host: geometry and outgoing radiance R.
        brdf: B, the material at every point.
        gains: how much brighter each photograph is than the others; none where all are taken to be alike.
        light, lamps: L, what arrives where nothing stands in the way, and small lamps close by, perhaps none.
        lobe: distribution of the specular reflection; none for Lambertian surfaces.
        stages: which losses count and what moves in each stage, for this kind of host.
        units: what errors of radiance are measured in.
        replay: surface points of earlier steps, for stages in which no surface moves.
        check_outputs: refuses what a host must not return.
        observers: called with the rays of every training step and what the host says of them, before anything
            is shaded.

    Raises:
        UserError: settings that do not go together (`settings.check`).
    """

    def __init__(self, host: Host, config: NeilfConfig, facts: SceneFacts, borrowed: bool = False) -> None:
        super().__init__()
        check_config(config)
        if borrowed:
            object.__setattr__(self, "host", host)  # past nn.Module, which would take it in
        else:
            self.host = host
        self.facts, self.borrowed = facts, borrowed
        self.units = radiance_units(config, facts)
        self.stages = host.stages if isinstance(host, HasStages) else BORROWED_HOST if borrowed else STAGES
        self.check_outputs = OutputCheck(host, config.shading.hit_share)
        self.observers: list[Callable[[PixelBatch, SurfaceHits], None]] = []
        self.brdf = BrdfField(config.brdf, config.encoding, config.volume.radius)
        albedo = initial_albedo(
            config.brdf.initial_base_color, config.brdf.initial_metallic, _lobe_of(config.shading)
        )
        has_gains = config.optimizer.exposure > 0 and len(facts.log_gains) > 0
        self.gains = PhotographGains(torch.tensor(facts.log_gains).view(-1, 3)) if has_gains else None
        parts = make_light(config, facts.response, facts.median_radiance / albedo)
        self.light, self.lamps = parts.light, parts.lamps
        self.use(config)
        # The surface of a borrowed host moves as its own trainer likes.
        stands_still = not borrowed and not self.stages[Stage.MATERIAL_INIT].moves_host
        self.replay = Replay(config.train.fresh if stands_still else 1.0, config.train.rays)

    def use(self, config: NeilfConfig) -> None:
        """Compute with these settings from now on. Effects change; the sizes of fields stay."""
        self.config = config
        self.lobe = _lobe_of(config.shading)
        self.brdf.use(config.brdf)
        if isinstance(self.light, EnvironmentLight):
            self.light.be_even(config.light.environment_height == 1)

    # ----------------------------------------------------------------------------------------------- one step

    def forward(self, batch: PixelBatch, stage: Stage, hits: SurfaceHits | None = None) -> StepResult:
        """`step`, under the name that data-parallel wrappers call."""
        return self.step(batch, stage, hits)

    def losses(self, batch: PixelBatch, stage: Stage, hits: SurfaceHits | None = None) -> LossTerms:
        """The losses of a step alone, before their weights."""
        return self.step(batch, stage, hits).terms

    def step(self, batch: PixelBatch, stage: Stage, hits: SurfaceHits | None = None) -> StepResult:
        """The losses that count in a stage, for a batch of pixels, and what the step showed of surface and
        sky. `hits` are what the host has rendered of the batch already; none: it is asked.
        """
        plan, names = self.stages[stage], active_losses(stage, self.config, self.stages)
        if not names:
            return StepResult.of({}, SurfacePixels.none_of(batch), batch[:0])
        settings, units = self.config.shading, self.units
        replays = self.training and not plan.moves_host
        if replays:
            batch, hits = self._first_rays(batch, hits)

        # 1. The host renders colour, hit position and normal.
        hits, terms = self._render_host(batch, plan, names, hits)
        if "volume" in names:
            color = hits.color
            if self.gains is not None:
                color = color * self.gains(batch.view)
                terms["exposure"] = losses.exposure(self.gains.drift())
            terms["volume"] = losses.photometric(color, batch.color, self.facts.response, units.volume)
        if not plan.moves_material:
            return StepResult.of(terms, SurfacePixels.none_of(batch), batch[:0])
        # From here on all photographs are as one of mean exposure. R, which sees all pixels, finds the gains.
        color = at_mean_exposure(self.gains, batch.color, batch.view, self.facts.response)
        batch = replace(batch, color=color)

        # 2. Rays that meet one surface, on the object, are shaded. The gradient to their hits is scaled.
        rows = torch.nonzero(hits.is_hit(settings.hit_share) & (batch.mask > 0.5))[:, 0]
        rendered = self._surface_pixels(hits[rows], batch[rows])
        surface = self.replay.beside_earlier(rendered) if replays else rendered

        # 3. The BRDF field says what the surface is made of.
        material, priors = self._material_and_priors(surface, names)
        terms |= priors

        # 4. Light, lamps and scene say what arrives.
        position, normal, wo = surface.position, surface.normal, surface.wo
        incident = self._arriving(position, normal, wo, material, settings.train_samples)

        # 5. The rendering equation says what leaves towards the camera.
        with doing("shading"):
            shading = shade(material, normal, wo, incident, self.lobe)
        terms["physical"] = losses.photometric(
            shading.color, surface.pixel, self.facts.response, units.physical
        )

        # 6. What arrives from another surface is what that surface sends.
        if "inter_reflection" in names:
            terms["inter_reflection"] = self._inter_reflection(position, normal)
        return StepResult.of(terms, rendered, self._beyond(batch, hits))

    def _first_rays(
        self, batch: PixelBatch, hits: SurfaceHits | None
    ) -> tuple[PixelBatch, SurfaceHits | None]:
        """The part of a batch that is rendered; points of earlier steps stand in for the rest."""
        first = slice(math.ceil(self.replay.share * len(batch)))
        return batch[first], None if hits is None else hits[first]

    @doing("rendering")
    def _render_host(
        self, batch: PixelBatch, plan: StagePlan, names: Mapping[str, float], hits: SurfaceHits | None
    ) -> tuple[SurfaceHits, dict[str, LossTerm]]:
        """Hits, and the host's own losses; constants in a stage that does not move the host."""
        with torch.set_grad_enabled(torch.is_grad_enabled() and plan.moves_host):
            if hits is not None:
                hits, terms = hits if torch.is_grad_enabled() else hits.detach(), {}
            elif isinstance(self.host, Regularised):
                rendered = self.host.render_regularised(batch, names)
                hits, terms = rendered.hits, dict(rendered.terms)
            else:
                hits, terms = self.host.render(batch.rays), {}
            self.check_outputs(batch.rays, hits, color_moves="volume" in names and torch.is_grad_enabled())
        if self.training:
            for observe in self.observers:
                observe(batch, hits)
        return hits, terms

    @doing("shading")
    def _surface_pixels(self, hits: SurfaceHits, pixels: PixelBatch) -> SurfacePixels:
        settings = self.config.loss
        return SurfacePixels(
            position=losses.scale_gradient(hits.position, settings.position_gradient),
            normal=losses.scale_gradient(
                self.shading_normals(hits.position, hits.normal), settings.normal_gradient
            ),
            wo=-pixels.directions,
            pixel=pixels.color,
            image_gradient=pixels.image_gradient,
        )

    @doing("shading")
    def _material_and_priors(
        self, surface: SurfacePixels, names: Mapping[str, float]
    ) -> tuple[Material, dict[str, LossTerm]]:
        """The material of surface points, and those of its priors that count."""
        priors = {}
        if "smoothness" in names:
            with doing("regularisers"):
                sample = self.brdf.with_gradients(surface.position)
            material, slopes = sample.material, (sample.roughness_gradient, sample.metallic_gradient)
            priors["smoothness"] = losses.smoothness(*slopes, surface.image_gradient)
        else:
            material = self.brdf(surface.position)
        if "lambertian" in names:
            priors["lambertian"] = losses.lambertian(material)
        return material, priors

    @doing("shading")
    def _arriving(
        self,
        position: Float[Tensor, "N 3"],
        normal: Float[Tensor, "N 3"],
        wo: Float[Tensor, "N 3"],
        material: Material,
        samples: int,
    ) -> Incident:
        """What arrives at surface points along `samples` directions each, drawn without gradients."""
        about, roughness, sampler = normal.detach(), material.roughness.detach(), self.config.shading.sampler
        drawn = draw_directions(sampler, self.light, about, wo, roughness, samples, self.lobe, self.training)
        return arriving(self.sources, position, drawn)

    @doing("tracing")
    def _inter_reflection(self, position: Float[Tensor, "P 3"], normal: Float[Tensor, "P 3"]) -> LossTerm:
        traced = trace_light(
            self.host, position, normal, self.config.inter_reflection, self.config.shading.hit_share
        )
        hit = torch.nonzero(traced.hit)[:, 0]
        incident = self.light.radiance(traced.position[hit], traced.wi[hit][:, None])[:, 0]
        return losses.inter_reflection(
            incident, traced.radiance[hit], self.units.incident, self.config.light.monochrome
        )

    def _beyond(self, batch: PixelBatch, hits: SurfaceHits) -> PixelBatch:
        """Pixels off the object, as far as masks tell, whose rays pass the scene by."""
        off_object = (batch.mask < 0.5) | (batch.mask_known == 0)
        return batch[torch.nonzero(off_object & (hits.opacity.detach() < CLEAR_OPACITY))[:, 0]]

    # ---------------------------------------------------------------------------------------------- the parts

    @property
    def scene(self) -> SceneTracer | None:
        """What the scene's own surfaces send, where inter-reflection is traced (hard); else none."""
        if self.config.inter_reflection.mode != "hard":
            return None
        return scene_tracer(self.host, self.config.inter_reflection, self.config.shading.hit_share)

    @property
    def sources(self) -> Sources:
        """Everything that sends light to a surface point."""
        return Sources(self.light, self.lamps, self.scene)

    def light_solver(self) -> LightSolver:
        """A new solver for this model's light, for the training loop: see `lighting.solver`."""
        light = LightModel(self.light, self.lamps)
        return make_light_solver(self.config.light, self.facts, self.units, light, self.lobe)

    def materials(self, x: Float[Tensor, "N 3"]) -> Material:
        """Base colour, roughness and metallic at points of the scene frame."""
        return self.brdf(x)

    def shading_normals(
        self, position: Float[Tensor, "N 3"], normal: Float[Tensor, "N 3"]
    ) -> Float[Tensor, "N 3"]:
        """Unit normals that hits are shaded with; their gradient is that of the hits' normals."""
        if not isinstance(self.host, SmoothsNormals):
            return normal
        smooth = self.host.smooth_normals(position.detach(), normal.detach())
        return smooth + (normal - normal.detach())

    def incident_light(self, x: Float[Tensor, "N 3"], wi: Float[Tensor, "N S 3"]) -> Float[Tensor, "N S 3"]:
        """Linear radiance that arrives at x from wi: from light and lamps, or from the scene before them."""
        return incident_radiance(self.sources, x, wi)

    @doing("shading")
    def shade(
        self,
        position: Float[Tensor, "N 3"],
        normal: Float[Tensor, "N 3"],
        wo: Float[Tensor, "N 3"],
        material: Material,
        samples: int,
    ) -> Shading:
        """Outgoing radiance towards wo by the rendering equation, from `samples` directions a point."""
        incident = self._arriving(position, normal, wo, material, samples)
        return shade(material, normal, wo, incident, self.lobe)

    @torch.no_grad()
    def maps(self, rays: RayBatch, with_material: bool = True, hits: SurfaceHits | None = None) -> Maps:
        """Everything that the rays show, for pictures and metrics. Bound the memory by the number of rays.

        `with_material` off asks neither the BRDF nor the light: `rgb` is then the host's colour. `hits` are
        what the host has rendered of the rays already; none: it is asked.
        """
        hits = self.host.render(rays) if hits is None else hits.detach()
        maps = Maps.of_host(rays, hits)
        rows = torch.nonzero(hits.opacity > SURFACE_OPACITY)[:, 0]
        if not with_material or not len(rows):
            return maps
        position, wo = hits.position[rows], -rays.directions[rows]
        normal = self.shading_normals(position, hits.normal[rows])
        material = self.brdf(position)
        shading = self.shade(position, normal, wo, material, self.config.shading.eval_samples)

        def on_surface(other: Float[Tensor, "N C"], value: Float[Tensor, "P C"]) -> Float[Tensor, "N C"]:
            return other.index_put((rows,), value.to(other.dtype))

        return replace(
            maps,
            rgb=on_surface(maps.rgb, shading.color),
            diffuse=on_surface(maps.diffuse, shading.diffuse),
            specular=on_surface(maps.specular, shading.specular),
            base_color=on_surface(maps.base_color, material.base_color),
            roughness=on_surface(maps.roughness, material.roughness),
            metallic=on_surface(maps.metallic, material.metallic),
            normal=on_surface(maps.normal, normal),
        )

    # --------------------------------------------------------------------------------------------- parameters

    def parameter_groups(self) -> dict[str, list[nn.Parameter]]:
        """Parameters by field, the host's among them where it offers them and is not borrowed."""
        offered = isinstance(self.host, HasParameterGroups) and not self.borrowed
        host = self.host.parameter_groups() if offered else {}
        own = {"brdf": self.brdf, "light": self.light}
        if self.gains is not None:
            own["exposure"] = self.gains
        return {**host, **{name: list(field.parameters()) for name, field in own.items()}}

    def freeze_for(self, stage: Stage) -> None:
        """Let exactly the fields move that the stage moves; the others get no gradient."""
        for name, parameters in self.parameter_groups().items():
            for parameter in parameters:
                parameter.requires_grad_(name in self.stages[stage].moves)
                parameter.grad = None


def _lobe_of(shading: ShadingConfig) -> Lobe | None:
    return LOBES[shading.lobe] if shading.specular else None
