"""NeILF++: a host that knows geometry and radiance, and the material and the light that explain what it sees.

One training step reads top to bottom in `NeilfModel.losses`, in the order of the paper's §4.2.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass

import torch
from jaxtyping import Float
from torch import Tensor, nn

from neilfpp_method import losses
from neilfpp_method.fields.brdf import BrdfField
from neilfpp_method.fields.environment import EnvironmentLight
from neilfpp_method.fields.incident_light import IncidentLightField
from neilfpp_method.fields.lamps import Lamps
from neilfpp_method.hosts.base import HasParameterGroups, HasStages, Host, Regularised, SmoothsNormals
from neilfpp_method.hosts.outputs import OutputCheck
from neilfpp_method.inter_reflection import before_light, scene_light, trace_light
from neilfpp_method.lighting.fit import Evidence
from neilfpp_method.lighting.memory import Observed, SurfaceMemory
from neilfpp_method.lighting.replay import Replay, SurfacePixels
from neilfpp_method.lighting.sky import SkySightings
from neilfpp_method.lighting.solve import solve_light
from neilfpp_method.schedule import BORROWED_HOST, STAGES, Stage, active_losses
from neilfpp_method.settings.check import check_config
from neilfpp_method.settings.facts import SceneFacts, radiance_units
from neilfpp_method.settings.types import NeilfConfig
from neilfpp_method.shading.albedo import directional_albedo
from neilfpp_method.shading.brdf import LOBES
from neilfpp_method.shading.rendering_equation import shade
from neilfpp_method.shading.sampling import Technique, sample_directions
from neilfpp_method.structures import (
    LossTerm,
    Material,
    PixelBatch,
    RayBatch,
    SceneLight,
    Shading,
    SurfaceHits,
)

__all__ = ["Maps", "NeilfModel"]


CLEAR = 0.01
"""Opacity of a ray that shows what lies beyond the scene."""


@dataclass(frozen=True)
class Maps:
    """Everything that a ray shows; one row a ray. Colours are linear. A ray that passes every surface by has the host's colour
    in `rgb`, and zeros for the material."""

    rgb: Float[Tensor, "N 3"]
    rgb_volume: Float[Tensor, "N 3"]
    diffuse: Float[Tensor, "N 3"]
    specular: Float[Tensor, "N 3"]
    base_color: Float[Tensor, "N 3"]
    roughness: Float[Tensor, "N 1"]
    metallic: Float[Tensor, "N 1"]
    normal: Float[Tensor, "N 3"]
    depth: Float[Tensor, "N 1"]
    opacity: Float[Tensor, "N 1"]


class NeilfModel(nn.Module):
    """The method on top of any host.

    Args:
        host: renders rays (`hosts.base.Host`); its parameters train with ours where it offers `parameter_groups`.
        config: the settings.
        facts: what the images decided.
        borrowed: the host belongs to another trainer. Its parameters, its device and its mode are then none of this
            module's, though gradients reach it in the joint stage.

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
        self.borrowed = borrowed
        self.stages = host.stages if isinstance(host, HasStages) else BORROWED_HOST if borrowed else STAGES
        self.check_outputs = OutputCheck(host, config.shading.hit_share)
        self.config = config
        self.facts = facts
        self.units = radiance_units(config, facts)
        self.lobe = LOBES[config.shading.lobe]
        self.brdf = BrdfField(config.brdf, config.volume.radius)
        base = config.light.base or (10.0 if facts.response == "linear" else math.e)
        first_radiance = facts.median_radiance / self._first_albedo()
        self.light: IncidentLightField | EnvironmentLight
        self.lamps: Lamps | None = None
        self.memory: SurfaceMemory | None = None
        self.evidence: Evidence | None = None
        # The surface of a borrowed host moves as its own trainer likes.
        stands_still = not borrowed and not self.stages[Stage.MATERIAL_INIT].moves_host
        train = config.train
        self.replay = Replay(train.fresh, train.rays) if train.fresh < 1 and stands_still else None
        self.seen_sky: SkySightings | None = None
        if config.light.kind != "free":
            fit = config.light.fit
            self.light = EnvironmentLight(config.light.environment_height, first_radiance)
            self.lamps = None if config.light.kind == "distant" else Lamps(fit.lamps, fit.lamp_radius)
            if config.light.map is None or self.lamps is not None:
                self.memory = SurfaceMemory(fit.points, fit.every)
            if config.light.map is None and facts.background == "inverted_sphere" and fit.sky > 0:
                self.seen_sky = SkySightings(config.light.environment_height, facts.response)
        else:
            self.light = IncidentLightField(config.light, base, first_radiance)

    # -------------------------------------------------------------------------------------------------------- one step

    def forward(self, batch: PixelBatch, stage: Stage) -> Mapping[str, LossTerm]:
        """`losses`, under the name that data-parallel wrappers call."""
        return self.losses(batch, stage)

    def losses(self, batch: PixelBatch, stage: Stage) -> Mapping[str, LossTerm]:
        """The losses that count in a stage, for a batch of pixels."""
        names = active_losses(stage, self.config, self.stages)
        plan = self.stages[stage]
        if not names:
            return {}

        # 1. The host renders colour, hit position and normal. Without a geometry stage they are constants, and some are known.
        replay = self.replay if self.training and not plan.moves_host else None
        if replay is not None:
            batch = batch[: math.ceil(replay.share * len(batch))]
        with torch.set_grad_enabled(torch.is_grad_enabled() and plan.moves_host):
            hits, terms = self._render_host(batch, names)
        if "volume" in names:
            terms["volume"] = losses.photometric(hits.color, batch.color, self.facts.response, self.units.volume)
        if not plan.moves_material:
            return terms
        if self.seen_sky is not None and self.training:
            outside = (batch.mask < 0.5) | (batch.mask_known == 0)
            self.seen_sky.remember(batch.directions, batch.color, outside & (hits.opacity.detach() < CLEAR))

        # 2. Rays that meet one surface, on the object, are shaded; a scaled gradient goes back to where they met it.
        rows = torch.nonzero((hits.is_hit(self.config.shading.hit_share)) & (batch.mask > 0.5))[:, 0]
        found = self._surface_pixels(hits[rows], batch[rows])
        seen = found if replay is None else replay.beside_earlier(found)

        # 3. The BRDF field says what the surface is made of.
        material = self._material_and_priors(seen, names, terms)

        # 4. The light says what arrives; an environment map is solved for from what has been seen, now and then.
        if self.memory is not None and self.training:
            self._keep_fitting(found.detach())

        # 5. The rendering equation says what leaves.
        shading = self.shade(seen.position, seen.normal, seen.wo, material, self.config.shading.train_samples)
        terms["physical"] = losses.photometric(shading.color, seen.pixel, self.facts.response, self.units.physical)

        # 6. What arrives from another surface is what that surface sends.
        if "inter_reflection" in names:
            terms["inter_reflection"] = self._inter_reflection(seen.position, seen.normal)
        return terms

    def _render_host(self, batch: PixelBatch, names: Mapping[str, float]) -> tuple[SurfaceHits, dict[str, LossTerm]]:
        if isinstance(self.host, Regularised):
            rendered = self.host.render_regularised(batch, names)
            hits, terms = rendered.hits, dict(rendered.terms)
        else:
            hits, terms = self.host.render(batch.rays), {}
        self.check_outputs(batch.rays, hits, color_moves="volume" in names and torch.is_grad_enabled())
        return hits, terms

    def _surface_pixels(self, hits: SurfaceHits, pixels: PixelBatch) -> SurfacePixels:
        settings = self.config.loss
        return SurfacePixels(
            position=losses.scale_gradient(hits.position, settings.position_gradient),
            normal=losses.scale_gradient(self.shading_normals(hits.position, hits.normal), settings.normal_gradient),
            wo=-pixels.directions,
            pixel=pixels.color,
            image_gradient=pixels.image_gradient,
        )

    def _material_and_priors(self, seen: SurfacePixels, names: Mapping[str, float], terms: dict[str, LossTerm]) -> Material:
        if "smoothness" in names:
            sample = self.brdf.with_gradients(seen.position)
            material = sample.material
            terms["smoothness"] = losses.smoothness(sample.roughness_gradient, sample.metallic_gradient, seen.image_gradient)
        else:
            material = self.brdf(seen.position)
        if "lambertian" in names:
            terms["lambertian"] = losses.lambertian(material)
        return material

    def _inter_reflection(self, position: Float[Tensor, "P 3"], normal: Float[Tensor, "P 3"]) -> LossTerm:
        traced = trace_light(self.host, position, normal, self.config.inter_reflection, self.config.shading.hit_share)
        hit = torch.nonzero(traced.hit)[:, 0]
        incident = self.light.radiance(traced.position[hit], traced.wi[hit][:, None])[:, 0]
        return losses.inter_reflection(incident, traced.radiance[hit], self.units.incident, self.config.light.monochrome)

    def _keep_fitting(self, seen: Observed) -> None:
        """Remember some of what was seen, and when it is time solve for the light that explains what is remembered."""
        self.memory.remember(seen)
        if not self.memory.due:
            return
        first, seen = self.memory.age is None, self.memory.recall()
        with torch.no_grad():
            material = self.brdf(seen.position)
        lobe = self.lobe if self.config.shading.specular else None
        scene = None if self.config.inter_reflection.mode == "off" else self._scene_light
        response, unit = self.facts.response, self.units.physical
        sky = None if self.seen_sky is None else self.seen_sky.known()
        self.evidence = solve_light(
            self.light, self.lamps, seen, material, lobe, scene, response, unit, self.config.light, first, sky
        )

    # ------------------------------------------------------------------------------------------------------- the parts

    def materials(self, x: Float[Tensor, "N 3"]) -> Material:
        """Base colour, roughness and metallic at points of the scene frame."""
        return self.brdf(x)

    def shading_normals(self, position: Float[Tensor, "N 3"], normal: Float[Tensor, "N 3"]) -> Float[Tensor, "N 3"]:
        """Unit normals at hits as surfaces are shaded with them; their gradient is that of the hits' normals."""
        if not isinstance(self.host, SmoothsNormals):
            return normal
        smooth = self.host.smooth_normals(position.detach(), normal.detach())
        return smooth + (normal - normal.detach())

    def incident_light(self, x: Float[Tensor, "N 3"], wi: Float[Tensor, "N S 3"]) -> Float[Tensor, "N S 3"]:
        """Linear radiance that arrives at x from wi: from the light, or in hard inter-reflection from the scene before it."""
        if self.config.inter_reflection.mode != "hard":
            radiance, nearest = self.light.radiance(x, wi), torch.full_like(wi[..., 0], math.inf)
        else:
            scene = self._scene_light(x, wi)
            radiance, nearest = before_light(scene, self.light.radiance, x, wi), scene.distance
        return radiance if self.lamps is None else radiance + self.lamps.seen(x, wi, nearest)

    def _scene_light(self, x: Float[Tensor, "N 3"], wi: Float[Tensor, "N S 3"]) -> SceneLight:
        """What the scene sends, by R."""
        return scene_light(self.host, x, wi, self.config.inter_reflection, self.config.shading.hit_share)

    def shade(
        self,
        position: Float[Tensor, "N 3"],
        normal: Float[Tensor, "N 3"],
        wo: Float[Tensor, "N 3"],
        material: Material,
        samples: int,
    ) -> Shading:
        """Outgoing radiance towards wo by the rendering equation, from `samples` incident directions per point."""
        settings = self.config.shading
        # Without a lobe there is nothing for a lobe to sample: the cosine has no variance left that light does not bring.
        without_lobe = {"mis": "cosine", "lobe": "cosine"}
        sampler = settings.sampler if settings.specular else without_lobe.get(settings.sampler, settings.sampler)
        about, roughness = normal.detach(), material.roughness.detach()
        drawn = sample_directions(sampler, about, wo, roughness, samples, self.lobe, self.training, self._sky(about))
        if self.config.inter_reflection.mode == "hard":
            incident = before_light(self._scene_light(position, drawn.wi), self.light.radiance, position, drawn.wi)
        else:
            incident = self.light.radiance(position, drawn.wi)
        shading = shade(material, normal, wo, drawn, incident, self.lobe, settings.specular)
        if self.lamps is None or not self.lamps.lit:
            return shading
        # Lamps are small and few: each is asked by itself, and no direction that another sampler draws meets one.
        rays = self.lamps.rays_from(position)
        radiance = self.lamps.arriving(rays)
        if self.config.inter_reflection.mode == "hard":
            radiance = radiance * (self._scene_light(position, rays.wi).distance >= rays.distance)[..., None]
        lit = shade(material, normal, wo, rays.samples(), radiance, self.lobe, settings.specular)
        return Shading(shading.color + lit.color, shading.diffuse + lit.diffuse, shading.specular + lit.specular)

    def _sky(self, normal: Float[Tensor, "N 3"]) -> Technique | None:
        """The map, as one that draws directions; none for a light that cannot be sampled."""
        light = self.light
        if not isinstance(light, EnvironmentLight):
            return None
        return Technique(lambda count, stochastic: light.sample(normal, count, stochastic).wi, light.pdf)

    @torch.no_grad()
    def maps(self, rays: RayBatch, with_material: bool = True) -> Maps:
        """Everything that the rays show, for pictures and metrics. Bound the memory by the number of rays.

        `with_material` off asks neither the BRDF nor the light: `rgb` is then the host's colour.
        """
        hits = self.host.render(rays)
        size = len(rays)
        surfaces = torch.zeros(size, 11, dtype=hits.color.dtype, device=hits.color.device)
        rgb, normals = hits.color.clone(), hits.normal.clone()
        # A picture has no holes: where a pixel sees two surfaces, too blurred to learn from, it shows what lies between them.
        rows = torch.nonzero(hits.opacity > 0.5)[:, 0]
        if with_material and len(rows):
            position, wo = hits.position[rows], -rays.directions[rows]
            normal = self.shading_normals(position, hits.normal[rows])
            normals[rows] = normal
            material = self.brdf(position)
            shading = self.shade(position, normal, wo, material, self.config.shading.eval_samples)
            rgb[rows] = shading.color
            surfaces[rows] = torch.cat(
                [shading.diffuse, shading.specular, material.base_color, material.roughness, material.metallic], dim=-1
            )
        diffuse, specular, base_color, roughness, metallic = surfaces.split([3, 3, 3, 1, 1], dim=-1)
        depth = ((hits.position - rays.origins) * rays.directions).sum(-1, keepdim=True)
        return Maps(rgb, hits.color, diffuse, specular, base_color, roughness, metallic, normals, depth, hits.opacity[:, None])

    # ------------------------------------------------------------------------------------------------------- parameters

    def parameter_groups(self) -> dict[str, list[nn.Parameter]]:
        """Parameters by field, the host's among them where it offers them and is not borrowed."""
        offered = isinstance(self.host, HasParameterGroups) and not self.borrowed
        host = self.host.parameter_groups() if offered else {}
        return {**host, "brdf": list(self.brdf.parameters()), "light": list(self.light.parameters())}

    def freeze_for(self, stage: Stage) -> None:
        """Let exactly the fields move that the stage moves; the others get no gradient."""
        for name, parameters in self.parameter_groups().items():
            for parameter in parameters:
                parameter.requires_grad_(name in self.stages[stage].moves)
                parameter.grad = None

    def _first_albedo(self) -> float:
        """Directional albedo of the material that B starts as, seen from the normal."""
        start = self.config.brdf
        if not self.config.shading.specular:
            return start.initial_base_color
        half, metallic = torch.full((1, 1), 0.5), torch.full((1, 1), start.initial_metallic)
        up = torch.tensor([[0.0, 0.0, 1.0]])
        material = Material(torch.full((1, 3), start.initial_base_color), half, metallic)
        return directional_albedo(material, up, up, self.lobe).mean().item()
