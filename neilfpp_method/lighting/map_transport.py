"""The transport from the texels of an environment map (see `transport`)."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import torch
from jaxtyping import Float, Int
from torch import Tensor

from neilfpp_method.fields.environment import EnvironmentLight
from neilfpp_method.lighting.transport import Transport, brdf_kernel, spans
from neilfpp_method.shading.brdf import Lobe
from neilfpp_method.shading.frame import dot
from neilfpp_method.structures import Observed, SceneLight, SceneTracer

__all__ = ["TexelRays", "from_texels", "trace_texels"]


@torch.no_grad()
def from_texels(
    environment: EnvironmentLight,
    observed: Observed,
    roughness: Float[Tensor, "N 1"],
    lobe: Lobe | None,
    scene: SceneTracer | None,
) -> Transport:
    """The transport from the texels of a map, per unit of radiance.

    One random direction per point and texel is traced.

    Args:
        environment: the map; only its shape is used, not its radiance.
        observed: the surface points, with unit normals and directions to the viewer.
        roughness: roughness at the points.
        lobe: the specular lobe; None for Lambertian surfaces.
        scene: traces rays from the points through the scene, which blocks light from the map and emits its
            own radiance; None if inter-reflection is off.
    """
    parts = []
    for span in spans(len(observed), environment.log_radiance[0].numel()):
        part = observed[span]
        rays = trace_texels(environment, part.position, part.normal, scene)
        parts.append(rays.transport(brdf_kernel(part, roughness[span], rays.wi, rays.weight, lobe)))
    return Transport.joined(parts)


@dataclass(frozen=True)
class TexelRays:
    """For each of N points one direction in each texel above its horizon.

    Attributes:
        wi: the directions.
        number: index of the texel.
        weight: cosine times solid angle of the texel.
        texels: number of texels of the map.
        scene_light: the light that the rays meet in the scene, and which rays meet it; None without a scene.
    """

    wi: Float[Tensor, "N S 3"]
    number: Int[Tensor, "N S"]
    weight: Float[Tensor, "N S"]
    texels: int
    scene_light: SceneLight | None

    @staticmethod
    def joined(parts: Sequence[TexelRays]) -> TexelRays:
        """The rays from the points of all parts."""
        wi, number, weight = (
            torch.cat([getattr(part, name) for part in parts]) for name in ("wi", "number", "weight")
        )
        lights = [part.scene_light for part in parts]
        scene_light = None if lights[0] is None else SceneLight.joined(lights)
        return TexelRays(wi, number, weight, parts[0].texels, scene_light)

    def __getitem__(self, points: Tensor) -> TexelRays:
        """The rays of some of the points."""
        scene_light = None if self.scene_light is None else self.scene_light[points]
        return TexelRays(self.wi[points], self.number[points], self.weight[points], self.texels, scene_light)

    def redrawn(self, environment: EnvironmentLight, observed: Observed) -> TexelRays:
        """The rays of N pixels with other directions in the same texels, and the same hits."""
        drawn = environment.texel_directions(observed.position)
        wi = drawn.wi.gather(1, self.number[..., None].expand(-1, -1, 3))
        weight = dot(wi, observed.normal).clamp_min(0) * drawn.solid_angle[self.number]
        return replace(self, wi=wi, weight=weight)

    def transport(self, kernel: Float[Tensor, "K N S"]) -> Transport:
        """The transport through a kernel, which is the BRDF times `weight`."""
        from_scene = kernel.new_zeros(*kernel.shape[:2], 3)
        if self.scene_light is not None:
            from_scene = torch.einsum("kns,nsc->knc", kernel, self.scene_light.radiance.to(kernel.dtype))
            kernel = kernel * ~self.scene_light.hit
        sources = kernel.new_zeros(*kernel.shape[:2], self.texels)
        return Transport(sources.scatter_(2, self.number.expand(len(kernel), -1, -1), kernel), from_scene)


def trace_texels(
    environment: EnvironmentLight,
    position: Float[Tensor, "N 3"],
    normal: Float[Tensor, "N 3"],
    scene: SceneTracer | None,
) -> TexelRays:
    """Trace one random direction in each texel above the horizon of each point."""
    drawn = environment.texel_directions(position)
    texels = len(drawn.solid_angle)
    weight = dot(drawn.wi, normal).clamp_min(0) * drawn.solid_angle
    # The texels are symmetric about the origin, so half of them lie above any horizon (up to those that the
    # horizon cuts).
    weight, number = weight.topk(texels // 2, dim=1)
    wi = drawn.wi.gather(1, number[..., None].expand(-1, -1, 3))
    scene_light = None if scene is None else scene(position, wi)
    return TexelRays(wi, number, weight, texels, scene_light)
