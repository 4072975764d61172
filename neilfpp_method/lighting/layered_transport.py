"""Light transport at several roughnesses at once.

All roughnesses share the rays. Of an unknown light, rays are traced once per surface point, however many
pixels show it (`texel_layers`); of a known light, they are drawn for each pixel (`light_layers`).

The result has one layer for each part of the BRDF (see `transport`): first the diffuse part, one layer for
each roughness if it depends on the roughness and else a single one, and then the facing and grazing parts at
each roughness. `layers_of` has their indices.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import TypeVar

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from neilfpp_method.fields.environment import EnvironmentLight
from neilfpp_method.fields.lamps import Lamps
from neilfpp_method.fields.light import LightModel
from neilfpp_method.lighting.lamp_transport import in_sight, lamp_kernel
from neilfpp_method.lighting.rays import from_scene, trace_rays, unblocked
from neilfpp_method.lighting.transport import Transport, kernel_of, spans
from neilfpp_method.shading.brdf import Lobe, cosines
from neilfpp_method.shading.frame import dot
from neilfpp_method.shading.sampling import Technique, cosine, specular_lobe
from neilfpp_method.structures import Observed, SceneLight, SceneTracer

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

COSINE_RAYS, LIGHT_RAYS, LOBE_RAYS = 64, 128, 24
"""Rays per pixel for a known light: in proportion to the cosine, to the light, and in each of the lobes of
`LOBE_ROUGHNESSES`. The standard error of a pixel of `tabletop_env` is 1 % of the diffuse part, and 2 to 3 %
of the facing part, from a roughness of 0.08 to 1. With two rays in each texel of the map, which are twenty
times as many, it was 1 % of the diffuse part, 8 % of the facing part at 0.2, and 140 % at 0.08.
"""
LOBE_ROUGHNESSES = (0.1, 0.3)
"""The light and the cosine sample rougher lobes well."""


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
    texels = environment.log_radiance[0].numel()
    traced = [
        _trace_texels(environment, shared.position[span], shared.normal[span], scene)
        for span in spans(len(shared.position), texels)
    ]
    rays = _TexelRays.joined(traced)
    parts = []
    for span in spans(len(shared.observed), texels):
        observed, of_point = shared.observed[span], rays[shared.point[span]]
        drawn = environment.texel_directions(observed.position)
        wi = drawn.wi.gather(1, of_point.texel[..., None].expand(-1, -1, 3))
        weight = dot(wi, observed.normal).clamp_min(0) * drawn.solid_angle[of_point.texel]
        kernel = _kernel_layers(observed, wi, weight, roughnesses, lobe)
        sources = kernel.new_zeros(*kernel.shape[:2], texels, dtype=torch.half)
        from_map = unblocked(kernel, of_point.scene_light).half()
        sources.scatter_(2, of_point.texel.expand(len(kernel), -1, -1), from_map)
        parts.append(Transport(sources, from_scene(kernel, of_point.scene_light)))
    return Transport.joined(parts)


@dataclass(frozen=True)
class _TexelRays:
    """Rays from P points, one in each of the T texels above their horizons.

    Attributes:
        texel: index of the texel of each ray.
        scene_light: the light that the rays meet in the scene, and which rays meet it; None without a scene.
    """

    texel: Int[Tensor, "P T"]
    scene_light: SceneLight | None

    @staticmethod
    def joined(parts: Sequence[_TexelRays]) -> _TexelRays:
        """The rays from the points of all parts."""
        lights = [part.scene_light for part in parts]
        scene_light = None if lights[0] is None else SceneLight.joined(lights)
        return _TexelRays(torch.cat([part.texel for part in parts]), scene_light)

    def __getitem__(self, points: Tensor) -> _TexelRays:
        """The rays of some of the points."""
        return _TexelRays(self.texel[points], None if self.scene_light is None else self.scene_light[points])


def _trace_texels(
    environment: EnvironmentLight,
    position: Float[Tensor, "P 3"],
    normal: Float[Tensor, "P 3"],
    scene: SceneTracer | None,
) -> _TexelRays:
    """Trace one random direction in each texel above the horizon of each point."""
    drawn = environment.texel_directions(position)
    weight = dot(drawn.wi, normal).clamp_min(0) * drawn.solid_angle
    # The texels are symmetric about the origin, so half of them lie above any horizon (up to those that the
    # horizon cuts).
    texel = weight.topk(len(drawn.solid_angle) // 2, dim=1).indices
    wi = drawn.wi.gather(1, texel[..., None].expand(-1, -1, 3))
    return _TexelRays(texel, None if scene is None else scene(position, wi))


@torch.no_grad()
def light_layers(
    light: LightModel,
    observed: Observed,
    roughnesses: Sequence[float],
    lobe: Lobe,
    scene: SceneTracer | None,
) -> LightLayers:
    """The layers of outgoing radiance that a known map, known lamps and the scene cause.

    Because the light is known, no transport matrix is needed, and the rays of each pixel are drawn where they
    matter (`_techniques`). All roughnesses share them.

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
        rays = trace_rays(part, _techniques(environment, part, lobe), scene)
        kernel = _kernel_layers(part, rays.wi, rays.weight, roughnesses, lobe)
        radiance = environment.radiance(part.position, rays.wi)
        from_map = torch.einsum("kns,nsc->knc", unblocked(kernel, rays.scene_light), radiance)
        parts.append(LightLayers(from_map, from_scene(kernel, rays.scene_light)))
    from_light = torch.cat([part.light for part in parts], 1)
    if lamps.count:
        sight = in_sight(lamps.lit_places, lamps.radius, observed.position, scene)
        from_light += lamp_layers(lamps, sight, observed, roughnesses, lobe)
    return LightLayers(from_light, torch.cat([part.scene for part in parts], 1))


def _techniques(environment: EnvironmentLight, observed: Observed, lobe: Lobe) -> list[tuple[Technique, int]]:
    """What draws the rays of each pixel, with the number of rays: the cosine, the light, and lobes."""
    normal, wo = observed.normal, observed.wo
    to_light = environment.technique(normal) or cosine(normal)
    lobes = [
        (specular_lobe(normal, wo, torch.full_like(normal[:, :1], roughness), lobe), LOBE_RAYS)
        for roughness in LOBE_ROUGHNESSES
    ]
    return [(cosine(normal), COSINE_RAYS), (to_light, LIGHT_RAYS), *lobes]


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
