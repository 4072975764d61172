"""Light transport to a surface and on to its viewer as matrices: radiance is linear in the light.

With geometry and roughness fixed, a map of T texels of radiance E and M lamps of intensity I,

    L_o = k_d (D E + D' I + d) + F0 (F E + F' I + f) + (G E + G' I + g)
    k_d = (1 − m) b,   F0 = 0.04 (1 − m) + b m

D, F, G hold cosine, visibility, solid angle, and the diffuse, the facing and the grazing part of the BRDF; d,
f, g are what the scene's own surfaces add.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from neilfpp_method.fields.environment import EnvironmentLight
from neilfpp_method.fields.lamps import LampPlaces, rays_towards
from neilfpp_method.shading.brdf import Lobe, diffuse_reflectance, normal_reflectance, specular_terms
from neilfpp_method.shading.frame import dot
from neilfpp_method.structures import Material, Observed, SceneLight, SceneTracer

__all__ = ["Transport", "from_lamps", "from_texels", "from_texels_at", "in_sight", "lamp_kernel"]

PAIRS_AT_ONCE = 2**18
"""Pairs of a point and a direction that are traced together: what bounds the memory."""


@dataclass(frozen=True)
class Transport:
    """How light leaves N points towards their viewers: the diffuse, the facing and the grazing part, in this
    order; K is 3, or 1 for Lambertian surfaces.

    `sources` is per unit of each of T sources, `scene` what the scene's own surfaces send through the points.
    """

    sources: Float[Tensor, "K N T"]
    scene: Float[Tensor, "K N 3"]

    def __getitem__(self, points: Tensor | slice) -> Transport:
        """The same for some of the points."""
        return Transport(self.sources[:, points], self.scene[:, points])

    def of(self, sources: Int[Tensor, " U"]) -> Transport:
        """From some of the sources."""
        return Transport(self.sources[..., sources], self.scene)

    def together(self) -> Transport:
        """One source: all of them, where they are equally strong."""
        return Transport(self.sources.sum(-1, keepdim=True), self.scene)

    def beside(self, other: Transport) -> Transport:
        """Both sets of sources."""
        return Transport(torch.cat((self.sources, other.sources), -1), self.scene + other.scene)

    def lit(self, strength: Float[Tensor, "T 3"]) -> Transport:
        """No sources: these, of a strength that is known, count as the scene's."""
        return Transport(self.sources[..., :0], self.scene + self.sources @ strength)

    def arriving(self, strength: Float[Tensor, "T 3"]) -> Float[Tensor, "K N 3"]:
        """The sum over all sources of this strength and the scene, before any color of the material."""
        return _SumOverSources.apply(self.sources, strength) + self.scene

    def outgoing(self, material: Material, strength: Float[Tensor, "T 3"]) -> Float[Tensor, "N 3"]:
        """L_o under sources of this strength, with the colours of `material` (roughness is fixed)."""
        diffuse, *reflected = self.arriving(strength)
        color = diffuse_reflectance(material, bool(reflected)) * diffuse
        if reflected:
            facing, grazing = reflected
            color = color + normal_reflectance(material) * facing + grazing
        return color


class _SumOverSources(torch.autograd.Function):
    """sources @ strength: K N T, T 3 → K N 3.

    Autograd's own slope in the strength reads the sources across their order in memory, which takes longer
    than along it; a fit does little else.
    """

    @staticmethod
    def forward(ctx, sources: Tensor, strength: Tensor) -> Tensor:
        ctx.save_for_backward(sources, strength)
        return sources @ strength

    @staticmethod
    def backward(ctx, slope: Tensor) -> tuple[Tensor | None, Tensor | None]:
        sources, strength = ctx.saved_tensors
        of_sources = slope @ strength.t() if ctx.needs_input_grad[0] else None
        of_strength = (
            (slope.flatten(0, 1).t() @ sources.flatten(0, 1)).t() if ctx.needs_input_grad[1] else None
        )
        return of_sources, of_strength


@torch.no_grad()
def from_texels(
    environment: EnvironmentLight,
    observed: Observed,
    roughness: Float[Tensor, "N 1"],
    lobe: Lobe | None,
    scene: SceneTracer | None,
) -> Transport:
    """From the texels of a map, per unit of radiance; one direction per point and texel is traced.

    Args:
        environment: whose texels are meant; its radiance plays no part.
        observed: surface points; unit normals and directions to the viewer.
        roughness: at the points.
        lobe: of the specular reflection; none for Lambertian surfaces.
        scene: stands between the points and the map, and shines on them; none where inter-reflection is off.
    """
    texels = environment.log_radiance[0].numel()
    parts = []
    for part, rough in _chunks(observed, roughness, texels):
        rays = _texel_rays(environment, part, scene)
        parts.append(rays.carried(_kernel(part, rough, rays.wi, rays.weight, lobe)))
    return _joined(parts)


@torch.no_grad()
def from_texels_at(
    environment: EnvironmentLight,
    observed: Observed,
    roughnesses: Sequence[float],
    lobe: Lobe,
    scene: SceneTracer | None,
) -> Transport:
    """As `from_texels`, at several roughnesses; directions are traced once; half-precision `sources`.

    Layer 0 is diffuse, layers 1 + 2k and 2 + 2k the facing and grazing parts at roughness number k.
    """
    texels = environment.log_radiance[0].numel()
    parts = []
    for part, rough in _chunks(observed, observed.position[:, :1], texels):
        rays = _texel_rays(environment, part, scene)
        kernels = [_kernel(part, torch.full_like(rough, r), rays.wi, rays.weight, lobe) for r in roughnesses]
        layers = [rays.carried(kernel if k == 0 else kernel[1:]) for k, kernel in enumerate(kernels)]
        parts.append(
            Transport(torch.cat([x.sources.half() for x in layers]), torch.cat([x.scene for x in layers]))
        )
    return _joined(parts)


@dataclass(frozen=True)
class _TexelRays:
    """For N points a direction in each texel above the horizon, its number among T texels, cosine times solid
    angle, and what stands there of the scene.
    """

    wi: Float[Tensor, "N S 3"]
    number: Int[Tensor, "N S"]
    weight: Float[Tensor, "N S"]
    texels: int
    met: SceneLight | None

    def carried(self, kernel: Float[Tensor, "K N S"]) -> Transport:
        """What leaves the points through a kernel."""
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
    # The map is symmetric about its centre: half of its texels are above any horizon, grazing ones aside.
    weight, number = weight.topk(texels // 2, dim=1)
    wi = drawn.wi.gather(1, number[..., None].expand(-1, -1, 3))
    met = None if scene is None else scene(observed.position, wi)
    return _TexelRays(wi, number, weight, texels, met)


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
    """From small lamps, per unit intensity, tracing to their middles. Arguments as of `from_texels`."""
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
    """Whether the middle of a lamp is to be observed from a point."""
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
    """`sources` of a transport from lamps; differentiable in place and axis, but not in visibility."""
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
    """The parts of the BRDF times a weight that holds cosine and solid angle."""
    if lobe is None:
        return weight[None] / math.pi
    terms = specular_terms(roughness, observed.normal, observed.wo, wi, lobe)
    return torch.stack((weight / math.pi, weight * terms.facing, weight * terms.grazing))


def _chunks(
    observed: Observed, roughness: Float[Tensor, "N 1"], sources: int
) -> list[tuple[Observed, Tensor]]:
    rows = max(1, PAIRS_AT_ONCE // max(1, sources))
    spans = [slice(start, start + rows) for start in range(0, max(1, len(observed)), rows)]
    return [(observed[span], roughness[span]) for span in spans]
