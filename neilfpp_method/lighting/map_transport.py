"""The transport from the texels of an environment map (see `transport`)."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import torch
from jaxtyping import Float, Int
from torch import Tensor

from neilfpp_method.fields.direction_map import interpolation_weights, texel_solid_angles, texels_of
from neilfpp_method.fields.environment import EnvironmentLight
from neilfpp_method.lighting.transport import Transport, brdf_kernel, spans
from neilfpp_method.shading.brdf import Lobe
from neilfpp_method.shading.frame import dot
from neilfpp_method.shading.sampling import Technique, specular_lobe
from neilfpp_method.structures import Observed, SceneLight, SceneTracer

__all__ = ["LIGHT_RAYS", "TexelRays", "from_texels", "trace_texels"]

LIGHT_RAYS = 64
"""Rays per point in directions that are drawn from the map itself. With one ray in each texel alone, what a
point receives from a sun of few texels is all or nothing at the edges of shadows; such noise is smallest
under a blurred sun, so a fit preferred one: of a true share of 30 % of all light within 3° it found 6 %, with
these rays 10 %, and 18 % once they are drawn from the sharper map.
"""
LOBE_RAYS = 32
"""Rays per point in directions that are drawn from its specular lobe. The lobe of a polished surface is
narrower than a texel: with one ray in each texel alone, the error of what a surface of roughness 0.14
reflects was a third; with these rays it is 2 %.
"""


@torch.no_grad()
def from_texels(
    environment: EnvironmentLight,
    observed: Observed,
    roughness: Float[Tensor, "N 1"],
    lobe: Lobe | None,
    scene: SceneTracer | None,
) -> Transport:
    """The transport from the texels of a map, between which radiance is interpolated, per unit of radiance.

    For each point, one random direction in each texel is traced, `LIGHT_RAYS` towards the light of the map,
    and `LOBE_RAYS` in the lobe.

    Args:
        environment: the map; its radiance only determines how rays are distributed.
        observed: the surface points, with unit normals and directions to the viewer.
        roughness: roughness at the points.
        lobe: the specular lobe; None for Lambertian surfaces.
        scene: traces rays from the points through the scene, which blocks light from the map and emits its
            own radiance; None if inter-reflection is off.
    """
    parts = []
    for span in spans(len(observed), environment.log_radiance[0].numel()):
        part = observed[span]
        to_light = environment.technique(part.normal)
        techniques = [] if to_light is None else [(to_light, LIGHT_RAYS)]
        if lobe is not None:
            techniques.append((specular_lobe(part.normal, part.wo, roughness[span], lobe), LOBE_RAYS))
        rays = trace_texels(environment, part.position, part.normal, scene)
        rays = rays.with_techniques(techniques, part.position, scene)
        kernel = brdf_kernel(part, roughness[span], rays.wi, rays.weight(part.normal), lobe)
        parts.append(rays.between_texels(kernel))
    return Transport.joined(parts)


@dataclass(frozen=True)
class TexelRays:
    """Rays from N points to a map: one in each texel above the horizon, and further ones (`with_techniques`).

    Attributes:
        wi: their directions.
        texel: index of the texel that contains each direction.
        density: expected number of rays per steradian at each direction (`_density`).
        size: rows and columns of the map.
        scene_light: the light that the rays meet in the scene, and which rays meet it; None without a scene.
    """

    wi: Float[Tensor, "N S 3"]
    texel: Int[Tensor, "N S"]
    density: Float[Tensor, "N S"]
    size: tuple[int, int]
    scene_light: SceneLight | None

    @staticmethod
    def joined(parts: Sequence[TexelRays]) -> TexelRays:
        """The rays from the points of all parts."""
        wi, texel, density = (
            torch.cat([getattr(part, name) for part in parts]) for name in ("wi", "texel", "density")
        )
        lights = [part.scene_light for part in parts]
        scene_light = None if lights[0] is None else SceneLight.joined(lights)
        return TexelRays(wi, texel, density, parts[0].size, scene_light)

    def __getitem__(self, points: Tensor) -> TexelRays:
        """The rays of some of the points."""
        scene_light = None if self.scene_light is None else self.scene_light[points]
        return TexelRays(self.wi[points], self.texel[points], self.density[points], self.size, scene_light)

    def redrawn(
        self,
        environment: EnvironmentLight,
        position: Float[Tensor, "N 3"],
        techniques: Sequence[tuple[Technique, int]] = (),
    ) -> TexelRays:
        """The rays with other directions in the same texels, and the same hits.

        Args:
            environment: the map.
            position: the points.
            techniques: those that drew the last rays of each point, which keep their directions.
        """
        drawn = environment.texel_directions(position)
        count = self.texel.shape[1] - sum(count for _, count in techniques)
        wi = drawn.wi.gather(1, self.texel[:, :count, None].expand(-1, -1, 3))
        wi = torch.cat((wi, self.wi[:, count:]), 1)
        return replace(self, wi=wi, density=_density(self.texel, wi, self.size, techniques))

    def with_techniques(
        self,
        techniques: Sequence[tuple[Technique, int]],
        position: Float[Tensor, "N 3"],
        scene: SceneTracer | None,
    ) -> TexelRays:
        """These rays, one in each texel, and those of other techniques, weighted by the balance heuristic.

        Args:
            techniques: each draws that number of further directions per point.
            position: the points from which they are traced.
            scene: as in `from_texels`.
        """
        if not techniques:
            return self
        drawn = torch.cat([technique.draw(count, True) for technique, count in techniques], 1)
        texel = torch.cat((self.texel, texels_of(drawn, *self.size)), 1)
        wi = torch.cat((self.wi, drawn), 1)
        density = _density(texel, wi, self.size, techniques)
        scene_light = None
        if scene is not None:
            further = scene(position, drawn)
            scene_light = self.scene_light.map_named(
                lambda name, rays: torch.cat((rays, getattr(further, name)), 1)
            )
        return TexelRays(wi, texel, density, self.size, scene_light)

    def weight(self, normal: Float[Tensor, "N 3"]) -> Float[Tensor, "N S"]:
        """Cosine about the normals of the points, divided by the density."""
        return dot(self.wi, normal).clamp_min(0) / self.density

    def between_texels(self, kernel: Float[Tensor, "K N S"]) -> Transport:
        """The transport through a kernel, which is the BRDF times `weight`; radiance is interpolated."""
        sources, free = self._no_sources(kernel), self._unblocked(kernel)
        for texel, weight in zip(*interpolation_weights(self.wi, *self.size), strict=True):
            sources.scatter_add_(2, texel.expand(len(kernel), -1, -1), free * weight)
        return Transport(sources, self.from_scene(kernel))

    def within_texels(self, kernel: Float[Tensor, "K N S"]) -> Transport:
        """As `between_texels`, with the same radiance in all of a texel; for one ray in each texel."""
        texel = self.texel.expand(len(kernel), -1, -1)
        sources = self._no_sources(kernel).scatter_(2, texel, self._unblocked(kernel))
        return Transport(sources, self.from_scene(kernel))

    def from_map(
        self, kernel: Float[Tensor, "K N S"], environment: EnvironmentLight
    ) -> Float[Tensor, "K N 3"]:
        """Outgoing radiance due to the map, through a kernel."""
        anywhere = torch.zeros_like(self.wi[:, 0])  # a map is the same at every point
        radiance = environment.radiance(anywhere, self.wi)
        return torch.einsum("kns,nsc->knc", self._unblocked(kernel), radiance)

    def from_scene(self, kernel: Float[Tensor, "K N S"]) -> Float[Tensor, "K N 3"]:
        """Outgoing radiance due to the surfaces that the rays meet, through a kernel."""
        if self.scene_light is None:
            return kernel.new_zeros(*kernel.shape[:2], 3)
        return torch.einsum("kns,nsc->knc", kernel, self.scene_light.radiance.to(kernel.dtype))

    def _unblocked(self, kernel: Float[Tensor, "K N S"]) -> Float[Tensor, "K N S"]:
        """The kernel with 0 where the scene blocks the map."""
        return kernel if self.scene_light is None else kernel * ~self.scene_light.hit

    def _no_sources(self, kernel: Float[Tensor, "K N S"]) -> Float[Tensor, "K N T"]:
        return kernel.new_zeros(*kernel.shape[:2], self.size[0] * self.size[1])


def trace_texels(
    environment: EnvironmentLight,
    position: Float[Tensor, "N 3"],
    normal: Float[Tensor, "N 3"],
    scene: SceneTracer | None,
) -> TexelRays:
    """Trace one random direction in each texel above the horizon of each point."""
    drawn = environment.texel_directions(position)
    height, width = environment.log_radiance.shape[1:]
    weight = dot(drawn.wi, normal).clamp_min(0) * drawn.solid_angle
    # The texels are symmetric about the origin, so half of them lie above any horizon (up to those that the
    # horizon cuts).
    texel = weight.topk(height * width // 2, dim=1).indices
    wi = drawn.wi.gather(1, texel[..., None].expand(-1, -1, 3))
    scene_light = None if scene is None else scene(position, wi)
    return TexelRays(wi, texel, _density(texel, wi, (height, width)), (height, width), scene_light)


def _density(
    texel: Int[Tensor, "N S"],
    wi: Float[Tensor, "N S 3"],
    size: tuple[int, int],
    techniques: Sequence[tuple[Technique, int]] = (),
) -> Float[Tensor, "N S"]:
    """Expected number of rays per steradian: one in each texel, and those that techniques draw."""
    solid_angle = texel_solid_angles(*size, wi.device).to(wi.dtype)
    return sum((count * technique.pdf(wi) for technique, count in techniques), 1.0 / solid_angle[texel])
