"""Light transport from sources via surface points to their viewers, as matrices.

With geometry and roughness fixed, outgoing radiance is linear in the light. For a map with T texels of
radiance E and M lamps of intensity I,

    L_o = k_d (D E + D' I + d) + F0 (F E + F' I + f) + (G E + G' I + g)
    k_d = (1 − m) b,   F0 = 0.04 (1 − m) + b m

The matrices D, F and G contain the cosine, the visibility, the solid angle, and the diffuse, facing and
grazing part of the BRDF. The vectors d, f and g are the light that arrives from other surfaces of the scene.

`map_transport` and `lamp_transport` compute these matrices for points of known roughness, and
`layered_transport` for several roughnesses at once.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import torch
from jaxtyping import Float, Int
from torch import Tensor

from neilfpp_method.kernels.products import times_channels
from neilfpp_method.shading.brdf import (
    Cosines,
    Lobe,
    brdf_terms,
    cosines,
    diffuse_reflectance,
    normal_reflectance,
)
from neilfpp_method.structures import Material, Observed

__all__ = ["Transport", "brdf_kernel", "kernel_of", "outgoing_radiance", "spans"]

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

    @staticmethod
    def joined(parts: Sequence[Transport]) -> Transport:
        """The transport from the same sources via the points of all parts."""
        return Transport(
            torch.cat([part.sources for part in parts], 1), torch.cat([part.scene for part in parts], 1)
        )

    def __getitem__(self, points: Tensor | slice) -> Transport:
        """The transport via some of the points."""
        return Transport(self.sources[:, points], self.scene[:, points])

    def reaching_any(self) -> Int[Tensor, " U"]:
        """Numbers of the sources that reach any point. Half of the texels of a map reach no table top."""
        return torch.nonzero(self.sources.amax((0, 1)))[:, 0]

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
        return Transport(self.sources[..., :0], self.scene + times_channels(self.sources, strength))

    def outgoing(self, material: Material, strength: Float[Tensor, "T 3"]) -> Float[Tensor, "N 3"]:
        """L_o for sources of this strength; see `outgoing_radiance`."""
        return outgoing_radiance(times_channels(self.sources, strength) + self.scene, material)


def outgoing_radiance(parts: Float[Tensor, "K N 3"], material: Material) -> Float[Tensor, "N 3"]:
    """L_o from its diffuse, facing and grazing parts, or from the diffuse part of Lambertian surfaces.

    Only base colour and metallic of `material` are read; the roughness is contained in the parts.
    """
    diffuse, *reflected = parts
    color = diffuse_reflectance(material, bool(reflected)) * diffuse
    if reflected:
        facing, grazing = reflected
        color = color + normal_reflectance(material) * facing + grazing
    return color


def brdf_kernel(
    observed: Observed,
    roughness: Float[Tensor, "N 1"],
    wi: Float[Tensor, "N S 3"],
    weight: Float[Tensor, "N S"],
    lobe: Lobe | None,
) -> Float[Tensor, "K N S"]:
    """The parts of the BRDF times `weight`, which contains the cosine and the solid angle."""
    if lobe is None:
        return weight[None] / math.pi
    return kernel_of(cosines(observed.normal, observed.wo, wi), roughness, weight, lobe)


def kernel_of(
    cos: Cosines, roughness: Float[Tensor, "N 1"], weight: Float[Tensor, "N S"], lobe: Lobe
) -> Float[Tensor, "3 N S"]:
    """`brdf_kernel` of known cosines, which several roughnesses share."""
    terms = brdf_terms(cos, roughness, lobe)
    return torch.stack((weight * terms.diffuse / math.pi, weight * terms.facing, weight * terms.grazing))


def spans(points: int, sources: int) -> list[slice]:
    """Slices of the points with at most `PAIRS_AT_ONCE` pairs of a point and a source each; at least one."""
    rows = max(1, PAIRS_AT_ONCE // max(1, sources))
    return [slice(start, start + rows) for start in range(0, max(1, points), rows)]
