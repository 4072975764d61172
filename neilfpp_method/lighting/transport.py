"""Light transport from sources via surface points to their viewers, as matrices.

With geometry and roughness fixed, outgoing radiance is linear in the light. For a map with T texels of
radiance E and M lamps of intensity I,

    L_o = k_d (D E + D' I + d) + F0 (F E + F' I + f) + (G E + G' I + g)
    k_d = (1 − m) b,   F0 = 0.04 (1 − m) + b m

The matrices D, F and G contain the cosine, the visibility, the solid angle, and the diffuse, facing and
grazing part of the BRDF. The vectors d, f and g are the light that arrives from other surfaces of the scene.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from neilfpp_method.fields.environment import EnvironmentLight
from neilfpp_method.fields.lamps import LampPlaces, rays_towards
from neilfpp_method.fields.light import LightModel
from neilfpp_method.shading.brdf import Lobe, diffuse_reflectance, normal_reflectance, specular_terms
from neilfpp_method.shading.frame import dot
from neilfpp_method.structures import Material, Observed, SceneLight, SceneTracer

__all__ = [
    "Transport",
    "arriving_at",
    "from_lamps",
    "from_texels",
    "from_texels_at",
    "in_sight",
    "lamp_kernel",
]

PAIRS_AT_ONCE = 2**18
"""Maximum number of pairs of a point and a direction that are traced at once; it bounds memory."""


@dataclass(frozen=True)
class Transport:
    """Transport from T sources via N points to their viewers.

    The first dimension of both tensors is the part of the BRDF: diffuse, facing and grazing (K = 3), or only
    diffuse for Lambertian surfaces (K = 1).

    Attributes:
        sources: outgoing radiance per unit of strength of each source.
        scene: outgoing radiance due to light that other surfaces of the scene send to the points.
    """

    sources: Float[Tensor, "K N T"]
    scene: Float[Tensor, "K N 3"]

    def __getitem__(self, points: Tensor | slice) -> Transport:
        """The transport via some of the points."""
        return Transport(self.sources[:, points], self.scene[:, points])

    def select_sources(self, sources: Int[Tensor, " U"]) -> Transport:
        """The transport from some of the sources."""
        return Transport(self.sources[..., sources], self.scene)

    def sum_sources(self) -> Transport:
        """The transport from a single source that stands for all of them at equal strength."""
        return Transport(self.sources.sum(-1, keepdim=True), self.scene)

    def concatenate(self, other: Transport) -> Transport:
        """The transport from the sources of both."""
        return Transport(torch.cat((self.sources, other.sources), -1), self.scene + other.scene)

    def with_strength(self, strength: Float[Tensor, "T 3"]) -> Transport:
        """A transport without sources, whose `scene` includes these sources at a known strength."""
        return Transport(self.sources[..., :0], self.scene + self.sources @ strength)

    def arriving(self, strength: Float[Tensor, "T 3"]) -> Float[Tensor, "K N 3"]:
        """Sum over the sources at this strength, plus the scene, before it is multiplied by base colors."""
        return _SumOverSources.apply(self.sources, strength) + self.scene

    def outgoing(self, material: Material, strength: Float[Tensor, "T 3"]) -> Float[Tensor, "N 3"]:
        """L_o for sources of this strength.

        Only base colour and metallic of `material` are read; the roughness is part of the transport.
        """
        diffuse, *reflected = self.arriving(strength)
        color = diffuse_reflectance(material, bool(reflected)) * diffuse
        if reflected:
            facing, grazing = reflected
            color = color + normal_reflectance(material) * facing + grazing
        return color


class _SumOverSources(torch.autograd.Function):
    """sources @ strength: (K, N, T) @ (T, 3) → (K, N, 3).

    The backward pass of autograd for `strength` multiplies by the transposed sources, which it does not read
    in the order of memory. The pass below reads them in order, which is faster; a fit spends most of its time
    here.
    """

    @staticmethod
    def forward(ctx, sources: Tensor, strength: Tensor) -> Tensor:
        ctx.save_for_backward(sources, strength)
        return sources @ strength

    @staticmethod
    def backward(ctx, grad: Tensor) -> tuple[Tensor | None, Tensor | None]:
        sources, strength = ctx.saved_tensors
        grad_sources = grad_strength = None
        if ctx.needs_input_grad[0]:
            grad_sources = grad @ strength.t()
        if ctx.needs_input_grad[1]:
            grad_strength = (grad.flatten(0, 1).t() @ sources.flatten(0, 1)).t()
        return grad_sources, grad_strength


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
    texels = environment.log_radiance[0].numel()
    parts = []
    for part, rough in _chunks(observed, roughness, texels):
        rays = _texel_rays(environment, part, scene)
        parts.append(rays.transport(_kernel(part, rough, rays.wi, rays.weight, lobe)))
    return _joined(parts)


@torch.no_grad()
def from_texels_at(
    environment: EnvironmentLight,
    points: Observed,
    observed: Observed,
    place: Int[Tensor, " N"],
    roughnesses: Sequence[float],
    lobe: Lobe,
    scene: SceneTracer | None,
) -> Transport:
    """The transport from the texels of a map at several roughnesses, to N pixels that show P surface points.

    One random direction per point and texel is traced, regardless of the number of pixels and roughnesses.
    What it hits occludes the whole texel. The BRDF of each pixel is evaluated in another random direction
    within the texel, so that the pixels of a point have independent errors.

    Args:
        environment: as in `from_texels`.
        points: the surface points; only their positions and normals are read.
        observed: the pixels.
        place: index of the surface point that each pixel shows.
        roughnesses: the values of roughness.
        lobe: as in `from_texels`.
        scene: as in `from_texels`.

    Returns:
        Layer 0 is the diffuse part; layers 1 + 2k and 2 + 2k are the facing and grazing parts at roughness
        number k. `sources` has half precision.
    """
    return _joined(list(_texel_parts_at(environment, points, observed, place, roughnesses, lobe, scene)))


@torch.no_grad()
def arriving_at(
    light: LightModel,
    points: Observed,
    observed: Observed,
    place: Int[Tensor, " N"],
    roughnesses: Sequence[float],
    lobe: Lobe,
    scene: SceneTracer | None,
) -> Float[Tensor, "K N 3"]:
    """The parts of outgoing radiance that a known map and known lamps cause at several roughnesses.

    The arguments and the first dimension of the result are those of `from_texels_at`. No transport matrix is
    stored, so that the map may have any size.
    """
    environment, lamps = light.light, light.lamps
    radiance = environment.log_radiance.exp().flatten(1).t()
    parts = _texel_parts_at(environment, points, observed, place, roughnesses, lobe, scene)
    total = torch.cat([part.sources.float() @ radiance + part.scene for part in parts], 1)
    if lamps.count:
        places = LampPlaces(lamps.position[: lamps.count], lamps.axis[: lamps.count])
        sight = in_sight(places, lamps.radius, points.position, scene)[place]
        for number, value in enumerate(roughnesses):
            roughness = torch.full_like(observed.position[:, :1], value)
            kernel = lamp_kernel(places, lamps.radius, sight, observed, roughness, lobe)
            sent = kernel @ lamps.intensity[: lamps.count]
            layers = slice(1 + 2 * number, 3 + 2 * number)
            total[layers] += sent[1:]
            if number == 0:
                total[0] += sent[0]
    return total


def _texel_parts_at(
    environment: EnvironmentLight,
    points: Observed,
    observed: Observed,
    place: Int[Tensor, " N"],
    roughnesses: Sequence[float],
    lobe: Lobe,
    scene: SceneTracer | None,
) -> Iterator[Transport]:
    """The parts of `from_texels_at` for consecutive spans of pixels."""
    texels = environment.log_radiance[0].numel()
    spans = _spans(len(points), texels)
    rays = _joined_rays([_texel_rays(environment, points[span], scene) for span in spans])
    for span in _spans(len(observed), texels):
        part = observed[span]
        shared = rays[place[span]].redrawn(environment, part)
        layers = []
        for number, value in enumerate(roughnesses):
            roughness = torch.full_like(part.position[:, :1], value)
            kernel = _kernel(part, roughness, shared.wi, shared.weight, lobe)
            layers.append(shared.transport(kernel if number == 0 else kernel[1:]))
        yield Transport(
            torch.cat([layer.sources.half() for layer in layers]),
            torch.cat([layer.scene for layer in layers]),
        )


@dataclass(frozen=True)
class _TexelRays:
    """For each of N points one direction in each texel above its horizon.

    Attributes:
        wi: the directions.
        number: index of the texel.
        weight: cosine times solid angle of the texel.
        texels: number of texels of the map.
        met: what the rays hit in the scene; None without a scene.
    """

    wi: Float[Tensor, "N S 3"]
    number: Int[Tensor, "N S"]
    weight: Float[Tensor, "N S"]
    texels: int
    met: SceneLight | None

    def __getitem__(self, points: Tensor) -> _TexelRays:
        """The rays of some of the points."""
        met = None if self.met is None else self.met[points]
        return _TexelRays(self.wi[points], self.number[points], self.weight[points], self.texels, met)

    def redrawn(self, environment: EnvironmentLight, observed: Observed) -> _TexelRays:
        """The rays of N pixels with other directions in the same texels, and the same hits."""
        drawn = environment.texel_directions(observed.position)
        wi = drawn.wi.gather(1, self.number[..., None].expand(-1, -1, 3))
        weight = dot(wi, observed.normal).clamp_min(0) * drawn.solid_angle[self.number]
        return replace(self, wi=wi, weight=weight)

    def transport(self, kernel: Float[Tensor, "K N S"]) -> Transport:
        """The transport through a kernel, which is the BRDF times `weight`."""
        sent = kernel.new_zeros(*kernel.shape[:2], 3)
        if self.met is not None:
            sent = torch.einsum("kns,nsc->knc", kernel, self.met.radiance.to(kernel.dtype))
            kernel = kernel * ~self.met.hit
        sources = kernel.new_zeros(*kernel.shape[:2], self.texels)
        return Transport(sources.scatter_(2, self.number.expand(len(kernel), -1, -1), kernel), sent)


def _texel_rays(environment: EnvironmentLight, observed: Observed, scene: SceneTracer | None) -> _TexelRays:
    drawn = environment.texel_directions(observed.position)
    texels = len(drawn.solid_angle)
    weight = dot(drawn.wi, observed.normal).clamp_min(0) * drawn.solid_angle
    # The texels are symmetric about the origin, so half of them lie above any horizon (up to those that the
    # horizon cuts).
    weight, number = weight.topk(texels // 2, dim=1)
    wi = drawn.wi.gather(1, number[..., None].expand(-1, -1, 3))
    met = None if scene is None else scene(observed.position, wi)
    return _TexelRays(wi, number, weight, texels, met)


def _joined_rays(parts: Sequence[_TexelRays]) -> _TexelRays:
    wi, number, weight = (torch.cat([getattr(p, name) for p in parts]) for name in ("wi", "number", "weight"))
    met = None
    if parts[0].met is not None:
        names = ("hit", "radiance", "distance")
        met = SceneLight(*(torch.cat([getattr(p.met, name) for p in parts]) for name in names))
    return _TexelRays(wi, number, weight, parts[0].texels, met)


def _joined(parts: Sequence[Transport]) -> Transport:
    return Transport(
        torch.cat([part.sources for part in parts], 1), torch.cat([part.scene for part in parts], 1)
    )


@torch.no_grad()
def from_lamps(
    lamps: LampPlaces,
    radius: float,
    observed: Observed,
    roughness: Float[Tensor, "N 1"],
    lobe: Lobe | None,
    scene: SceneTracer | None,
) -> Transport:
    """The transport from small lamps, per unit of intensity; shadow rays go to their centres.

    Args:
        lamps: positions and axes of the lamps.
        radius: radius of every lamp, in scene units.
        observed: as in `from_texels`, like the remaining arguments.
        roughness: as in `from_texels`.
        lobe: as in `from_texels`.
        scene: as in `from_texels`; it blocks light, but its own radiance is not added.
    """
    sources = []
    for part, rough in _chunks(observed, roughness, len(lamps.position)):
        sight = in_sight(lamps, radius, part.position, scene)
        sources.append(lamp_kernel(lamps, radius, sight, part, rough, lobe))
    kernel = torch.cat(sources, 1)
    return Transport(kernel, kernel.new_zeros(*kernel.shape[:2], 3))


@torch.no_grad()
def in_sight(
    lamps: LampPlaces, radius: float, x: Float[Tensor, "N 3"], scene: SceneTracer | None
) -> Bool[Tensor, "N M"]:
    """Whether the centre of a lamp is visible from a point."""
    rays = rays_towards(x, lamps.position, lamps.axis, radius)
    if scene is None:
        return torch.ones_like(rays.distance, dtype=torch.bool)
    return scene(x, rays.wi).distance >= rays.distance


def lamp_kernel(
    lamps: LampPlaces,
    radius: float,
    sight: Bool[Tensor, "N M"],
    observed: Observed,
    roughness: Float[Tensor, "N 1"],
    lobe: Lobe | None,
) -> Float[Tensor, "K N M"]:
    """The `sources` of a transport from lamps, differentiable in their positions and axes.

    The visibility `sight` is a constant; see `in_sight`.
    """
    rays = rays_towards(observed.position, lamps.position, lamps.axis, radius)
    weight = sight * rays.emission * dot(rays.wi, observed.normal).clamp_min(0) / rays.distance.square()
    return _kernel(observed, roughness, rays.wi, weight, lobe)


def _kernel(
    observed: Observed,
    roughness: Float[Tensor, "N 1"],
    wi: Float[Tensor, "N S 3"],
    weight: Float[Tensor, "N S"],
    lobe: Lobe | None,
) -> Float[Tensor, "K N S"]:
    """The parts of the BRDF times `weight`, which contains the cosine and the solid angle."""
    if lobe is None:
        return weight[None] / math.pi
    terms = specular_terms(roughness, observed.normal, observed.wo, wi, lobe)
    return torch.stack((weight / math.pi, weight * terms.facing, weight * terms.grazing))


def _chunks(
    observed: Observed, roughness: Float[Tensor, "N 1"], sources: int
) -> list[tuple[Observed, Tensor]]:
    """Split points into chunks of at most `PAIRS_AT_ONCE` pairs of a point and a source."""
    return [(observed[span], roughness[span]) for span in _spans(len(observed), sources)]


def _spans(points: int, sources: int) -> list[slice]:
    """Slices of at most `PAIRS_AT_ONCE` pairs of a point and a source; at least one."""
    rows = max(1, PAIRS_AT_ONCE // max(1, sources))
    return [slice(start, start + rows) for start in range(0, max(1, points), rows)]
