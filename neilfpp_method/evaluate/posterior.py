"""Expected error of a material given its views: the posterior of base colour, roughness and metallic.

What a point sends to a viewer is linear in its base colour once roughness and metallic are given:

    L = b [(1 − m) D + m F(r)] + 0.04 (1 − m) F(r) + G(r)

with D, F, G the diffuse, the facing and the grazing part. So roughness and metallic run over a grid, and for
each of its cells the base colour is solved for: a normal distribution per channel, cut off at 0 and 1.
Nothing is linearised, and a surface that could as well be a metal as not is found to be just that.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from neilfpp_method.structures import Indexable, Material

__all__ = ["ROUGHNESS_NODES", "Deviation", "Looks", "Sights", "expected_error", "guessed_error"]

ROUGHNESS_NODES = (0.05, 0.15, 0.25, 0.35, 0.5, 0.65, 0.8, 1.0)
"""Roughnesses at which F and G are computed; between them both are interpolated linearly."""
ROUGHNESS_CELLS, METALLIC_CELLS = 20, 9
"""Cells of the grid over which the posterior is summed."""
PRIOR_PRECISION = 1e-2
"""Precision of the prior on a channel of base colour: nearly uniform within [0, 1]."""


@dataclass(frozen=True)
class Deviation(Indexable):
    """Expected root mean square error of an estimate in its own units; base colour: channel mean."""

    base_color: Float[Tensor, "N 1"]
    roughness: Float[Tensor, "N 1"]
    metallic: Float[Tensor, "N 1"]


@dataclass(frozen=True)
class Looks(Indexable):
    """What N points send to V viewers: `diffuse` is D, the others F and G at each of `ROUGHNESS_NODES`."""

    diffuse: Float[Tensor, "N 3"]
    facing: Float[Tensor, "N V R 3"]
    grazing: Float[Tensor, "N V R 3"]


@dataclass(frozen=True)
class Sights(Indexable):
    """What the viewers saw, and what may be wrong with comparing it.

    Attributes:
        seen: which of the views saw the point.
        radiance: linear.
        noise: standard deviation of an error that each view has of its own, above 0.
        shared: standard deviations of K errors that all views of the point, of one channel, have in common:
            what each adds to each view.
    """

    seen: Bool[Tensor, "N V"]
    radiance: Float[Tensor, "N V 3"]
    noise: Float[Tensor, "N V 3"]
    shared: Float[Tensor, "N V 3 K"]


@torch.no_grad()
def expected_error(looks: Looks, sights: Sights, estimate: Material, specular: bool = True) -> Deviation:
    """The deviation of an estimate under the posterior, what it is off from the posterior's mean included.

    The prior of base colour and roughness is even on [0, 1]; that of metallic leans to the ends, as the
    arcsine distribution does: most surfaces are a metal or none. A point that no view saw has the deviation
    from the prior. Without a specular part L is b D, and the deviations of roughness and metallic mean
    nothing.
    """
    wide = {"dtype": torch.float64, "device": looks.diffuse.device}
    metallic = torch.linspace(0, 1, METALLIC_CELLS, **wide) if specular else torch.zeros(1, **wide)
    roughness = (torch.arange(ROUGHNESS_CELLS, **wide) + 0.5) / ROUGHNESS_CELLS
    products = _Products.of(looks, sights, _between_nodes(roughness))
    base_color = _solve(products, metallic)

    log_prior = torch.linspace(0, 1, len(metallic) + 1).to(metallic).sqrt().asin().diff().log()
    weight = (
        (base_color.log_evidence.sum(1) + log_prior)
        .flatten(1)
        .softmax(-1)
        .unflatten(1, (ROUGHNESS_CELLS, -1))
    )
    off = base_color.variance + (base_color.mean - estimate.base_color[:, :, None, None]).square()
    squares = (
        (weight[:, None] * off).sum((2, 3)).mean(1, keepdim=True),
        (weight.sum(2) * (roughness - estimate.roughness).square()).sum(1, keepdim=True),
        (weight.sum(1) * (metallic - estimate.metallic).square()).sum(1, keepdim=True),
    )
    return Deviation(*(square.sqrt().to(looks.diffuse.dtype) for square in squares))


def guessed_error(estimate: Material) -> Deviation:
    """The deviation of an estimate under the prior alone: that of a guess."""
    even, to_the_ends = 1 / 12, 1 / 8  # variances about one half
    off = [(value - 0.5).square() for value in (estimate.base_color, estimate.roughness, estimate.metallic)]
    return Deviation(
        (even + off[0].mean(1, keepdim=True)).sqrt(), (even + off[1]).sqrt(), (to_the_ends + off[2]).sqrt()
    )


def _between_nodes(roughness: Float[Tensor, " Q"]) -> Float[Tensor, "R Q"]:
    """What each node counts for at each roughness; beyond the first and the last, those alone."""
    nodes = roughness.new_tensor(ROUGHNESS_NODES)
    right = torch.searchsorted(nodes, roughness).clamp(1, len(nodes) - 1)
    share = ((roughness - nodes[right - 1]) / (nodes[right] - nodes[right - 1])).clamp(0, 1)
    rows = torch.arange(len(roughness), device=nodes.device)
    weight = nodes.new_zeros(len(nodes), len(roughness))
    weight[right - 1, rows], weight[right, rows] = 1 - share, share
    return weight


@dataclass(frozen=True)
class _Products:
    """Inner products over the views, in units of the errors: of D and F, and of both and R = radiance − G
    with R; the last axis is that of metallic.
    """

    dd: Float[Tensor, "N 3 1 1"]
    df: Float[Tensor, "N 3 Q 1"]
    ff: Float[Tensor, "N 3 Q 1"]
    dr: Float[Tensor, "N 3 Q 1"]
    fr: Float[Tensor, "N 3 Q 1"]
    rr: Float[Tensor, "N 3 Q 1"]

    @classmethod
    def of(cls, looks: Looks, sights: Sights, between: Float[Tensor, "R Q"]) -> _Products:
        """Errors that views have in common are taken out by the Cholesky factor of their covariance."""
        # In double precision: shared errors are far larger than those of single views, and what tells one
        # cell of the grid from another is a small difference of large numbers.
        scale = (sights.seen[..., None] / sights.noise).double()
        shared = (sights.shared * scale[..., None]).transpose(1, 2)
        covariance = shared @ shared.mT + torch.eye(shared.shape[2], device=shared.device, dtype=shared.dtype)
        factor = torch.linalg.cholesky(covariance)
        count = len(ROUGHNESS_NODES)
        columns = (looks.diffuse[:, None, None].expand(-1, scale.shape[1], 1, 3), sights.radiance[:, :, None])
        stacked = torch.cat((looks.facing, looks.grazing, *columns), 2) * scale[:, :, None]
        white = torch.linalg.solve_triangular(factor, stacked.permute(0, 3, 1, 2), upper=False)
        facing, grazing, d, radiance = white.split((count, count, 1, 1), -1)
        f, r = facing @ between, radiance - grazing @ between
        return cls(*((a * b).sum(2)[..., None] for a, b in ((d, d), (d, f), (f, f), (d, r), (f, r), (r, r))))


@dataclass(frozen=True)
class _BaseColor:
    """Base colour given roughness and metallic, and the log likelihood of both given the views."""

    mean: Float[Tensor, "N 3 Q M"]
    variance: Float[Tensor, "N 3 Q M"]
    log_evidence: Float[Tensor, "N 3 Q M"]


def _solve(products: _Products, m: Float[Tensor, " M"]) -> _BaseColor:
    """Least squares for b in R − k F = b A, A = (1 − m) D + m F, k = 0.04 (1 − m), clamped to [0, 1]."""
    p, k = products, 0.04 * (1 - m)
    aa = (1 - m).square() * p.dd + 2 * m * (1 - m) * p.df + m.square() * p.ff
    ar = (1 - m) * p.dr + m * p.fr - k * ((1 - m) * p.df + m * p.ff)
    rr = p.rr - 2 * k * p.fr + k.square() * p.ff
    precision = aa + PRIOR_PRECISION
    centre = (ar + 0.5 * PRIOR_PRECISION) / precision
    width = precision.rsqrt()
    low, high = -centre / width, (1 - centre) / width

    # Both ends are mirrored into the lower tail, where the normal distribution keeps its digits.
    mirrored = low + high > 0
    below = torch.special.log_ndtr(torch.where(mirrored, -high, low))
    above = torch.special.log_ndtr(torch.where(mirrored, -low, high))
    log_mass = above + (-torch.expm1(below - above)).clamp_min(1e-7).log()
    # No density at an end exceeds its bound here; far out, where exponents lose digits, the bound holds.
    at_low, at_high = (
        torch.exp(-end.square() / 2 - math.log(2 * math.pi) / 2 - log_mass).minimum(
            end.abs() + 1 + 1 / (high - low)
        )
        for end in (low, high)
    )
    shift = at_low - at_high
    mean = (centre + width * shift).clamp(0, 1)
    variance = (1 + low * at_low - high * at_high - shift.square()).clamp(0, 1) * width.square()
    log_evidence = (precision * centre.square() - rr) / 2 + width.log() + log_mass
    return _BaseColor(mean, variance.clamp_max(1 / 12), log_evidence)
