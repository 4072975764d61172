"""The transport from the texels of an environment map (see `transport`)."""

from __future__ import annotations

import torch
from jaxtyping import Float
from torch import Tensor

from neilfpp_method.fields.direction_map import interpolation_weights
from neilfpp_method.fields.environment import EnvironmentLight
from neilfpp_method.lighting.rays import from_scene, trace_rays, unblocked
from neilfpp_method.lighting.transport import Transport, brdf_kernel, spans
from neilfpp_method.shading.brdf import Lobe
from neilfpp_method.shading.sampling import cosine, specular_lobe
from neilfpp_method.structures import Observed, SceneTracer

__all__ = ["from_texels"]

COSINE_RAYS, LIGHT_RAYS, LOBE_RAYS = 192, 192, 32
"""Rays per point: in proportion to the cosine, to the light of the map, and in the specular lobe. Together
they have less noise than one ray in each texel of a map of 48 rows with 64 to the light and 32 in the lobe,
which are six times as many (1.0 and 1.6 % of a pixel of `tabletop_env`). Rays to the light matter for suns:
noise is smallest under a blurred one, which a fit then prefers. Rays in the lobe matter for polished
surfaces, whose lobe is narrower than a texel.
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

    Args:
        environment: the map; its radiance only determines how rays are distributed.
        observed: the surface points, with unit normals and directions to the viewer.
        roughness: roughness at the points.
        lobe: the specular lobe; None for Lambertian surfaces.
        scene: traces rays from the points through the scene, which blocks light from the map and emits its
            own radiance; None if inter-reflection is off.
    """
    height, width = environment.log_radiance.shape[1:]
    parts = []
    for span in spans(len(observed), height * width):
        part = observed[span]
        to_light = environment.technique(part.normal) or cosine(part.normal)
        techniques = [(cosine(part.normal), COSINE_RAYS), (to_light, LIGHT_RAYS)]
        if lobe is not None:
            techniques.append((specular_lobe(part.normal, part.wo, roughness[span], lobe), LOBE_RAYS))
        rays = trace_rays(part, techniques, scene)
        kernel = brdf_kernel(part, roughness[span], rays.wi, rays.weight, lobe)
        from_map = unblocked(kernel, rays.scene_light)
        sources = kernel.new_zeros(*kernel.shape[:2], height * width)
        for texel, weight in zip(*interpolation_weights(rays.wi, height, width), strict=True):
            sources.scatter_add_(2, texel.expand(len(kernel), -1, -1), from_map * weight)
        parts.append(Transport(sources, from_scene(kernel, rays.scene_light)))
    return Transport.joined(parts)
