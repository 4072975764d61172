"""Expected error of a material given its views: the posterior of base colour, roughness and metallic.

For a given roughness r and metallic m, the outgoing radiance is linear in the base colour b:

    L = b [(1 − m) D(r) + m F(r)] + 0.04 (1 − m) F(r) + G(r)

D is the diffuse part, F and G are the specular lobe times 1 − (1 − cos)⁵ and (1 − cos)⁵, the two parts of
Schlick's Fresnel term. The posterior is summed over a grid of roughness and metallic. In each cell of the
grid, the base colour has a normal distribution per channel, truncated to [0, 1], in closed form. No
linearisation is needed, and a posterior with two modes (metal or not) is represented as such.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from neilfpp_method.shading.brdf import DIELECTRIC_F0
from neilfpp_method.structures import Indexable, Material

__all__ = ["ROUGHNESS_NODES", "Deviation", "Observations", "RadianceParts", "expected_error", "prior_error"]

ROUGHNESS_NODES = (0.05, 0.15, 0.25, 0.35, 0.5, 0.65, 0.8, 1.0)
"""Values of roughness at which D, F and G are computed; they are interpolated linearly between them."""
ROUGHNESS_CELLS, METALLIC_CELLS = 20, 9
"""Size of the grid over which the posterior is summed."""
PRIOR_PRECISION = 1e-2
"""Inverse variance of the normal prior of a channel of base colour: nearly uniform within [0, 1]."""


@dataclass(frozen=True)
class Deviation(Indexable):
    """Expected root mean square errors of a material; that of base colour is taken over its channels."""

    base_color: Float[Tensor, "N 1"]
    roughness: Float[Tensor, "N 1"]
    metallic: Float[Tensor, "N 1"]


@dataclass(frozen=True)
class RadianceParts(Indexable):
    """Parts of the radiance that N points send to V viewers.

    Attributes:
        diffuse: D at each of the R `ROUGHNESS_NODES`; Lambert's is the same for all viewers and roughnesses.
        facing: F at each of the R `ROUGHNESS_NODES`.
        grazing: G at each of the R `ROUGHNESS_NODES`.
    """

    diffuse: Float[Tensor, "N V R 3"]
    facing: Float[Tensor, "N V R 3"]
    grazing: Float[Tensor, "N V R 3"]


@dataclass(frozen=True)
class Observations(Indexable):
    """Radiance that V views observe of N points, and the errors to expect when it is compared with a model.

    Attributes:
        visible: which of the views see the point.
        radiance: observed linear radiance.
        noise: standard deviation of the error that is independent between views; above 0.
        shared: K errors that all views of a point have in common, per channel: what one standard deviation
            of each adds to each view.
    """

    visible: Bool[Tensor, "N V"]
    radiance: Float[Tensor, "N V 3"]
    noise: Float[Tensor, "N V 3"]
    shared: Float[Tensor, "N V 3 K"]


@torch.no_grad()
def expected_error(
    parts: RadianceParts, observations: Observations, estimate: Material, specular: bool = True
) -> Deviation:
    """Compute the root mean square error of an estimate under the posterior.

    It includes the difference between the estimate and the mean of the posterior. The prior of base colour
    and roughness is uniform on [0, 1]; that of metallic is the arcsine distribution, which prefers 0 and 1
    because most surfaces are entirely metal or not metal. A point that no view sees has the error under the
    prior.

    Args:
        parts: parts of the outgoing radiance.
        observations: the observed radiance.
        estimate: the material whose error is computed.
        specular: if False, L = b D, and the results for roughness and metallic are meaningless.
    """
    wide = {"dtype": torch.float64, "device": parts.diffuse.device}
    metallic = torch.linspace(0, 1, METALLIC_CELLS, **wide) if specular else torch.zeros(1, **wide)
    roughness = (torch.arange(ROUGHNESS_CELLS, **wide) + 0.5) / ROUGHNESS_CELLS
    products = _Products.of(parts, observations, _between_nodes(roughness))
    base_color = _solve(products, metallic)

    log_prior = torch.linspace(0, 1, len(metallic) + 1).to(metallic).sqrt().asin().diff().log()
    log_posterior = base_color.log_evidence.sum(1) + log_prior
    weight = log_posterior.flatten(1).softmax(-1).unflatten(1, (ROUGHNESS_CELLS, -1))
    square_error = base_color.variance + (base_color.mean - estimate.base_color[:, :, None, None]).square()
    squares = (
        (weight[:, None] * square_error).sum((2, 3)).mean(1, keepdim=True),
        (weight.sum(2) * (roughness - estimate.roughness).square()).sum(1, keepdim=True),
        (weight.sum(1) * (metallic - estimate.metallic).square()).sum(1, keepdim=True),
    )
    return Deviation(*(square.sqrt().to(parts.diffuse.dtype) for square in squares))


def prior_error(estimate: Material) -> Deviation:
    """Compute the root mean square error of an estimate under the prior: that of a guess."""
    # Both priors have mean 1/2.
    uniform_variance, arcsine_variance = 1 / 12, 1 / 8
    return Deviation(
        (uniform_variance + (estimate.base_color - 0.5).square().mean(1, keepdim=True)).sqrt(),
        (uniform_variance + (estimate.roughness - 0.5).square()).sqrt(),
        (arcsine_variance + (estimate.metallic - 0.5).square()).sqrt(),
    )


def _between_nodes(roughness: Float[Tensor, " Q"]) -> Float[Tensor, "R Q"]:
    """Weights of linear interpolation: of each node, at each roughness; constant beyond the outer nodes."""
    nodes = roughness.new_tensor(ROUGHNESS_NODES)
    right = torch.searchsorted(nodes, roughness).clamp(1, len(nodes) - 1)
    share = ((roughness - nodes[right - 1]) / (nodes[right] - nodes[right - 1])).clamp(0, 1)
    rows = torch.arange(len(roughness), device=nodes.device)
    weight = nodes.new_zeros(len(nodes), len(roughness))
    weight[right - 1, rows], weight[right, rows] = 1 - share, share
    return weight


@dataclass(frozen=True)
class _Products:
    """Inner products over views of D, F and R = radiance − G, whitened by the covariance of the errors.

    Q is the number of roughness values; the last axis is broadcast over metallic.
    """

    dd: Float[Tensor, "N 3 Q 1"]
    df: Float[Tensor, "N 3 Q 1"]
    ff: Float[Tensor, "N 3 Q 1"]
    dr: Float[Tensor, "N 3 Q 1"]
    fr: Float[Tensor, "N 3 Q 1"]
    rr: Float[Tensor, "N 3 Q 1"]

    @classmethod
    def of(
        cls, parts: RadianceParts, observations: Observations, interpolation: Float[Tensor, "R Q"]
    ) -> _Products:
        """Whiten by the Cholesky factor of the covariance, then take the products."""
        # Double precision, because shared errors are far larger than those of single views, and the cells of
        # the grid differ by a small difference of large numbers.
        scale = (observations.visible[..., None] / observations.noise).double()
        shared = (observations.shared * scale[..., None]).transpose(1, 2)
        covariance = shared @ shared.mT + torch.eye(shared.shape[2], device=shared.device, dtype=shared.dtype)
        factor = torch.linalg.cholesky(covariance)
        count = len(ROUGHNESS_NODES)
        radiance = observations.radiance[:, :, None]
        stacked = torch.cat((parts.diffuse, parts.facing, parts.grazing, radiance), 2) * scale[:, :, None]
        white = torch.linalg.solve_triangular(factor, stacked.permute(0, 3, 1, 2), upper=False)
        diffuse, facing, grazing, radiance = white.split((count, count, count, 1), -1)
        d, f, r = diffuse @ interpolation, facing @ interpolation, radiance - grazing @ interpolation
        return cls(*((a * b).sum(2)[..., None] for a, b in ((d, d), (d, f), (f, f), (d, r), (f, r), (r, r))))


@dataclass(frozen=True)
class _BaseColor:
    """Mean and variance of base colour in each grid cell, and the log evidence of the cell per channel."""

    mean: Float[Tensor, "N 3 Q M"]
    variance: Float[Tensor, "N 3 Q M"]
    log_evidence: Float[Tensor, "N 3 Q M"]


def _solve(products: _Products, m: Float[Tensor, " M"]) -> _BaseColor:
    """Solve R − k F = b A for b, with A = (1 − m) D + m F and k = 0.04 (1 − m), b truncated to [0, 1]."""
    p, k = products, DIELECTRIC_F0 * (1 - m)
    aa = (1 - m).square() * p.dd + 2 * m * (1 - m) * p.df + m.square() * p.ff
    ar = (1 - m) * p.dr + m * p.fr - k * ((1 - m) * p.df + m * p.ff)
    rr = p.rr - 2 * k * p.fr + k.square() * p.ff
    precision = aa + PRIOR_PRECISION
    center = (ar + 0.5 * PRIOR_PRECISION) / precision
    width = precision.rsqrt()
    low, high = -center / width, (1 - center) / width

    # Mirror both ends into the lower tail, where log_ndtr keeps its relative precision.
    mirrored = low + high > 0
    below = torch.special.log_ndtr(torch.where(mirrored, -high, low))
    above = torch.special.log_ndtr(torch.where(mirrored, -low, high))
    log_mass = above + (-torch.expm1(below - above)).clamp_min(1e-7).log()
    # The bound on the density at an end always holds mathematically. It matters far in the tail, where the
    # difference of exponents loses its digits.
    at_low, at_high = (
        torch.exp(-end.square() / 2 - math.log(2 * math.pi) / 2 - log_mass).minimum(
            end.abs() + 1 + 1 / (high - low)
        )
        for end in (low, high)
    )
    shift = at_low - at_high
    mean = (center + width * shift).clamp(0, 1)
    variance = (1 + low * at_low - high * at_high - shift.square()).clamp(0, 1) * width.square()
    log_evidence = (precision * center.square() - rr) / 2 + width.log() + log_mass
    return _BaseColor(mean, variance.clamp_max(1 / 12), log_evidence)
