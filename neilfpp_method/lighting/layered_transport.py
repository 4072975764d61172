"""Light transport at several roughnesses at once, for pixels that share surface points.

Rays are traced once per surface point, regardless of how many pixels show it and how many roughnesses are
tried. The result has one layer for each part of the BRDF (see `transport`): first the diffuse part, one layer
for each roughness if it depends on the roughness and else a single one, and then the facing and grazing parts
at each roughness. `layers_of` has their indices.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import TypeVar

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from neilfpp_method.fields.environment import EnvironmentLight
from neilfpp_method.fields.lamps import Lamps
from neilfpp_method.fields.light import LightModel
from neilfpp_method.lighting.lamp_transport import in_sight, lamp_kernel
from neilfpp_method.lighting.map_transport import LIGHT_RAYS, TexelRays, trace_texels
from neilfpp_method.lighting.transport import Transport, kernel_of, spans
from neilfpp_method.shading.brdf import Lobe, cosines
from neilfpp_method.shading.sampling import Technique
from neilfpp_method.structures import Observed, SceneTracer

__all__ = [
    "LightLayers",
    "SharedPoints",
    "diffuse_layers",
    "lamp_layers",
    "layers_at",
    "layers_of",
    "light_layers",
    "texel_layers",
]

Number = TypeVar("Number", int, Tensor)


@dataclass(frozen=True)
class SharedPoints:
    """P surface points, each shown by some of N pixels.

    Attributes:
        position: the points from which rays are traced, scene frame.
        normal: their unit normals.
        observed: the surface point that each pixel shows, for its normal and its direction to the viewer.
        point: index of the point at which the rays of each pixel start.
    """

    position: Float[Tensor, "P 3"]
    normal: Float[Tensor, "P 3"]
    observed: Observed
    point: Int[Tensor, " N"]


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
    environment: EnvironmentLight,
    shared: SharedPoints,
    roughnesses: Sequence[float],
    lobe: Lobe,
    scene: SceneTracer | None,
) -> Transport:
    """The transport from the texels of a map at several roughnesses, per unit of radiance.

    One random direction per point and texel is traced, and what it hits occludes the whole texel. The BRDF of
    each pixel is evaluated in another random direction within the texel, so that the pixels of a point have
    independent errors.

    Args:
        environment: the map; only its shape is used, not its radiance.
        shared: the surface points and the pixels that show them.
        roughnesses: the values of roughness.
        lobe: the specular lobe.
        scene: as in `map_transport.from_texels`.

    Returns:
        The transport in layers; `sources` has half precision.
    """
    parts = []
    for rays, kernel in _kernels(environment, shared, roughnesses, lobe, scene):
        part = rays.within_texels(kernel)
        parts.append(Transport(part.sources.half(), part.scene))
    return Transport.joined(parts)


@torch.no_grad()
def light_layers(
    light: LightModel,
    shared: SharedPoints,
    roughnesses: Sequence[float],
    lobe: Lobe,
    scene: SceneTracer | None,
) -> LightLayers:
    """The layers of outgoing radiance that a known map, known lamps and the scene cause.

    No transport matrix is stored, but a ray from each point towards each texel, and `LIGHT_RAYS` towards the
    light of the map. Without the latter, the noise of the diffuse part is three times as large, and surfaces
    that reflect less specularly, under a weaker light, seem to explain the pixels better.

    Arguments as in `texel_layers`.
    """
    environment, lamps = light.light, light.lamps
    parts = [
        LightLayers(rays.from_map(kernel, environment), rays.from_scene(kernel))
        for rays, kernel in _kernels(environment, shared, roughnesses, lobe, scene, LIGHT_RAYS)
    ]
    from_light = torch.cat([part.light for part in parts], 1)
    from_scene = torch.cat([part.scene for part in parts], 1)
    if lamps.count:
        sight = in_sight(lamps.lit_places, lamps.radius, shared.position, scene)[shared.point]
        from_light += lamp_layers(lamps, sight, shared.observed, roughnesses, lobe)
    return LightLayers(from_light, from_scene)


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


def _kernels(
    environment: EnvironmentLight,
    shared: SharedPoints,
    roughnesses: Sequence[float],
    lobe: Lobe,
    scene: SceneTracer | None,
    light_rays: int = 0,
) -> Iterator[tuple[TexelRays, Float[Tensor, "K N S"]]]:
    """For consecutive spans of pixels, their rays and the layers of the BRDF times the rays' weights.

    `light_rays` rays per point, besides one in each texel, are drawn from the light of the map.
    """
    texels = environment.log_radiance[0].numel()

    def to_light(normal: Float[Tensor, "N 3"]) -> list[tuple[Technique, int]]:
        technique = environment.technique(normal) if light_rays else None
        return [] if technique is None else [(technique, light_rays)]

    parts = []
    for span in spans(len(shared.position), texels):
        position, normal = shared.position[span], shared.normal[span]
        traced = trace_texels(environment, position, normal, scene)
        parts.append(traced.with_techniques(to_light(normal), position, scene))
    rays = TexelRays.joined(parts)
    for span in spans(len(shared.observed), texels):
        observed = shared.observed[span]
        point = shared.point[span]
        drawn = rays[point].redrawn(environment, observed.position, to_light(shared.normal[point]))
        weight = drawn.weight(observed.normal)
        cos = cosines(observed.normal, observed.wo, drawn.wi)
        kernels = [
            kernel_of(cos, torch.full_like(observed.position[:, :1], value), weight, lobe)
            for value in roughnesses
        ]
        yield drawn, _in_layers(kernels, lobe)
