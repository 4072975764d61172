"""Light transport at several roughnesses at once.

All roughnesses share the rays of a pixel. The result has one layer for each part of the BRDF (see
`transport`): first the diffuse part, one layer for each roughness if it depends on the roughness and else a
single one, and then the facing and grazing parts at each roughness. `layers_of` has their indices.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import TypeVar

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from neilfpp_method.fields.direction_map import texels_of
from neilfpp_method.fields.lamps import Lamps
from neilfpp_method.fields.light import LightModel
from neilfpp_method.fields.map_sampling import one_in_each_texel
from neilfpp_method.lighting.lamp_transport import in_sight, lamp_kernel
from neilfpp_method.lighting.rays import from_scene, trace_rays, unblocked
from neilfpp_method.lighting.transport import Transport, kernel_of, spans
from neilfpp_method.shading.brdf import Lobe, cosines
from neilfpp_method.shading.sampling import Technique, cosine, specular_lobe
from neilfpp_method.structures import Observed, SceneTracer

__all__ = [
    "LightLayers",
    "diffuse_layers",
    "lamp_layers",
    "layers_at",
    "layers_of",
    "light_layers",
    "texel_layers",
]

Number = TypeVar("Number", int, Tensor)

COSINE_RAYS, LIGHT_RAYS, LOBE_RAYS = 64, 128, 24
"""Rays per pixel for a known light: in proportion to the cosine, to the light, and in each of the lobes of
`LOBE_ROUGHNESSES`. The standard error of a pixel of `tabletop_env` is 1 % of the diffuse part, and 2 to 3 %
of the facing part, from a roughness of 0.08 to 1. With two rays in each texel of the map, which are twenty
times as many, it was 1 % of the diffuse part, 8 % of the facing part at 0.2, and 140 % at 0.08.
"""
LOBE_ROUGHNESSES = (0.1, 0.3)
"""The light and the cosine sample rougher lobes well."""


@dataclass(frozen=True)
class LightLayers:
    """The layers of outgoing radiance at N pixels.

    Attributes:
        light: the part that the map and the lamps cause.
        scene: the part that the radiance of other surfaces causes.
    """

    light: Float[Tensor, "K N 3"]
    scene: Float[Tensor, "K N 3"]


@torch.no_grad()
def texel_layers(
    height: int,
    width: int,
    observed: Observed,
    roughnesses: Sequence[float],
    lobe: Lobe,
    scene: SceneTracer | None,
) -> Transport:
    """The transport from the texels of a map at several roughnesses, per unit of radiance.

    Within a texel radiance is constant. From each pixel's surface point one ray is traced to each texel above
    the horizon, because the light is not known, and `LOBE_RAYS` in each lobe of `LOBE_ROUGHNESSES`.

    Args:
        height, width: size of the map.
        observed: the surface point that each pixel shows, with unit normals and directions to the viewer.
        roughnesses: the values of roughness.
        lobe: the specular lobe.
        scene: as in `map_transport.from_texels`.

    Returns:
        The transport in layers; `sources` has half precision.
    """
    texels, parts = height * width, []
    for span in spans(len(observed), texels):
        part = observed[span]
        to_texels = one_in_each_texel(height, width, part.normal)
        rays = trace_rays(part, [(to_texels, texels // 2), *_lobes(part, lobe)], scene)
        kernel = _kernel_layers(part, rays.wi, rays.weight, roughnesses, lobe)
        texel = texels_of(rays.wi, height, width).expand(len(kernel), -1, -1)
        from_map = unblocked(kernel, rays.scene_light)
        sources = kernel.new_zeros(*kernel.shape[:2], texels).scatter_add_(2, texel, from_map)
        parts.append(Transport(sources.half(), from_scene(kernel, rays.scene_light)))
    return Transport.joined(parts)


@torch.no_grad()
def light_layers(
    light: LightModel,
    observed: Observed,
    roughnesses: Sequence[float],
    lobe: Lobe,
    scene: SceneTracer | None,
) -> LightLayers:
    """The layers of outgoing radiance that a known map, known lamps and the scene cause.

    Because the light is known, no transport matrix is needed, and rays are drawn where they matter. All
    roughnesses share them.

    Args:
        light: the map and the lamps.
        observed: the surface point that each pixel shows, with unit normals and directions to the viewer.
        roughnesses: the values of roughness.
        lobe: the specular lobe.
        scene: as in `map_transport.from_texels`.
    """
    environment, lamps = light.light, light.lamps
    parts = []
    for span in spans(len(observed), COSINE_RAYS + LIGHT_RAYS + LOBE_RAYS * len(LOBE_ROUGHNESSES)):
        part = observed[span]
        to_light = environment.technique(part.normal) or cosine(part.normal)
        techniques = [(cosine(part.normal), COSINE_RAYS), (to_light, LIGHT_RAYS), *_lobes(part, lobe)]
        rays = trace_rays(part, techniques, scene)
        kernel = _kernel_layers(part, rays.wi, rays.weight, roughnesses, lobe)
        radiance = environment.radiance(part.position, rays.wi)
        from_map = torch.einsum("kns,nsc->knc", unblocked(kernel, rays.scene_light), radiance)
        parts.append(LightLayers(from_map, from_scene(kernel, rays.scene_light)))
    from_light = torch.cat([part.light for part in parts], 1)
    if lamps.count:
        sight = in_sight(lamps.lit_places, lamps.radius, observed.position, scene)
        from_light += lamp_layers(lamps, sight, observed, roughnesses, lobe)
    return LightLayers(from_light, torch.cat([part.scene for part in parts], 1))


def _lobes(observed: Observed, lobe: Lobe) -> list[tuple[Technique, int]]:
    """Techniques that draw from lobes of `LOBE_ROUGHNESSES`, with the number of rays."""
    normal, wo = observed.normal, observed.wo
    return [
        (specular_lobe(normal, wo, torch.full_like(normal[:, :1], roughness), lobe), LOBE_RAYS)
        for roughness in LOBE_ROUGHNESSES
    ]


def lamp_layers(
    lamps: Lamps,
    sight: Bool[Tensor, "N M"],
    observed: Observed,
    roughnesses: Sequence[float],
    lobe: Lobe,
) -> Float[Tensor, "K N 3"]:
    """The layers of outgoing radiance that the lit lamps cause.

    Args:
        lamps: the lamps.
        sight: which of the lit lamps are visible from each point (`lamp_transport.in_sight`).
        observed: the surface points, with unit normals and directions to the viewer.
        roughnesses: the values of roughness.
        lobe: the specular lobe.
    """
    kernels = []
    for value in roughnesses:
        roughness = torch.full_like(observed.position[:, :1], value)
        kernel = lamp_kernel(lamps.lit_places, lamps.radius, sight, observed, roughness, lobe)
        kernels.append(kernel @ lamps.lit_intensity)
    return _in_layers(kernels, lobe)


def diffuse_layers(layers: int, roughnesses: int) -> int:
    """Number of diffuse layers, which come first, among all layers of this number of roughnesses."""
    return layers - 2 * roughnesses


def layers_of(number: Number, layers: int, roughnesses: int) -> tuple[Number, Number, Number]:
    """Indices of the layers of the diffuse, facing and grazing part at a roughness.

    Args:
        number: index of the roughness.
        layers: number of all layers.
        roughnesses: number of roughnesses.

    Example:
        >>> layers_of(2, layers=7, roughnesses=3), layers_of(2, layers=9, roughnesses=3)
        ((0, 5, 6), (2, 7, 8))
    """
    diffuse = diffuse_layers(layers, roughnesses)
    return number * int(diffuse > 1), diffuse + 2 * number, diffuse + 2 * number + 1


def layers_at(layers: Tensor, number: Int[Tensor, " N"], roughnesses: int) -> Tensor:
    """The diffuse, facing and grazing parts of each pixel at its own roughness.

    Args:
        layers: (K, N, C) all layers.
        number: index of the roughness of each pixel.
        roughnesses: number of roughnesses.

    Returns:
        (3, N, C) the three parts.
    """
    rows = torch.arange(len(number), device=number.device)
    return layers[torch.stack(layers_of(number, len(layers), roughnesses)), rows]


def _in_layers(kernels: Sequence[Tensor], lobe: Lobe) -> Tensor:
    """All layers, from the three parts (3, N, C) at each roughness."""
    diffuse = kernels[:1] if lobe.diffuse is None else kernels
    return torch.cat([kernel[:1] for kernel in diffuse] + [kernel[1:] for kernel in kernels])


def _kernel_layers(
    observed: Observed,
    wi: Float[Tensor, "N S 3"],
    weight: Float[Tensor, "N S"],
    roughnesses: Sequence[float],
    lobe: Lobe,
) -> Float[Tensor, "K N S"]:
    """The layers of the BRDF times `weight` (`transport.brdf_kernel`)."""
    cos = cosines(observed.normal, observed.wo, wi)
    constant = [torch.full_like(observed.position[:, :1], roughness) for roughness in roughnesses]
    return _in_layers([kernel_of(cos, roughness, weight, lobe) for roughness in constant], lobe)
