"""The sampler of distances along rays for VolSDF's density, with bounded opacity error (VolSDF §3).

The sampler cuts a ray into intervals, bounds the error of the opacity under a density that is constant on
each interval, and adds cuts where they lower that bound most. No gradient flows through samples.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import torch
from jaxtyping import Float
from torch import Tensor

from neilfpp_method.structures import RayBatch
from neilfpp_method.volume.compositing import render_weights
from neilfpp_method.volume.density import laplace_density
from neilfpp_method.volume.distance_grid import SignedDistance
from neilfpp_method.volume.intersect import Interval
from neilfpp_method.volume.partition import Partition, SampleCounts, first_cuts, samples_within, with_cuts

__all__ = [
    "OPACITY_ERROR",
    "ErrorBoundedSamples",
    "error_bounded_samples",
]

OPACITY_ERROR = 0.1
"""Bound ε on the error of the opacity (VolSDF)."""

BISECTIONS = 10
"""Number of bisection steps on β (published code)."""


# -------------------------------------------------------------------------------------------- the error bound


def optical_depth(partition: Partition, beta: Float[Tensor, "#N 1"]) -> Float[Tensor, "N K"]:
    """Optical depth R̂ up to the start of each interval, with constant density per interval (VolSDF §3.3)."""
    depth = laplace_density(partition.sdf[:, :-1], beta) * partition.width
    return torch.nn.functional.pad(depth[:, :-1], (1, 0)).cumsum(dim=-1)


def depth_error(partition: Partition, beta: Float[Tensor, "#N 1"]) -> Float[Tensor, "N K"]:
    """Bound Ê on the error of R̂ up to the end of each interval: Σ δ² exp(−d*/β) / (4 β²) (VolSDF §3.3).

    It holds if |∇ sdf| ≤ 1; then the slope of the density is at most exp(−d*/β) / (2 β²) (Theorem 1).
    """
    share = torch.exp(-partition.least_distance / beta) * (partition.width / (2.0 * beta)).square()
    return share.cumsum(dim=-1)


def log_error_bound(partition: Partition, beta: Float[Tensor, "#N 1"]) -> Float[Tensor, "N 1"]:
    """Log of the bound on |O − Ô| along the ray: max_k exp(−R̂_k) (exp(Ê_{k+1}) − 1) (VolSDF Theorem 2).

    Logarithms are used because exp(Ê) can overflow although its product with exp(−R̂) is small.
    """
    error = depth_error(partition, beta)
    log_growth = error + torch.log(-torch.expm1(-error))
    return (log_growth - optical_depth(partition, beta)).amax(dim=-1, keepdim=True)


def bound_shares(partition: Partition, beta: Float[Tensor, "N 1"]) -> Float[Tensor, "N K"]:
    """Contribution of each interval to the error bound, exp(Ê − R̂) · ΔÊ, normalised: where new cuts help.

    The paper distributes new cuts by the bound itself, which accumulates along the ray: behind a grazed
    surface it stays high although cuts there do not lower it. The contributions need fewer queries for the
    same bound.
    """
    log_share = (
        2.0 * partition.width.clamp_min(torch.finfo(beta.dtype).tiny).log() - partition.least_distance / beta
    )
    return torch.softmax(log_share + depth_error(partition, beta) - optical_depth(partition, beta), dim=-1)


def bounded_beta(
    partition: Partition, beta: Float[Tensor, "#N 1"], beta_plus: Float[Tensor, "N 1"]
) -> Float[Tensor, "N 1"]:
    """The smallest scale in [β, β₊] for which the bound is ≤ ε, by bisection; β₊ if there is none.

    The bisection is in log space, because β and β₊ may differ by orders of magnitude.
    """
    low, high = beta.expand_as(beta_plus), beta_plus
    for _ in range(BISECTIONS):
        middle = (low * high).sqrt()
        is_bounded = log_error_bound(partition, middle) <= math.log(OPACITY_ERROR)
        low, high = torch.where(is_bounded, low, middle), torch.where(is_bounded, middle, high)
    return high


# ---------------------------------------------------------------------------------- the error-bounded sampler


@dataclass(frozen=True)
class ErrorBoundedSamples:
    """Samples of rays, with their error bound and cost.

    Attributes:
        distances: distances of the samples, ascending.
        error_bound: bound on the error of the opacity at the true β, at most 1; it holds if |∇ sdf| ≤ 1. If
            it is above `OPACITY_ERROR`, the rounds were used up, and the samples follow a wider density.
        sdf_queries: number of SDF queries per ray, averaged over the rays.
    """

    distances: Float[Tensor, "N M"]
    error_bound: Float[Tensor, " N"]
    sdf_queries: float


@torch.no_grad()
def error_bounded_samples(
    sdf: SignedDistance,
    rays: RayBatch,
    interval: Interval,
    beta: Float[Tensor, ""],
    counts: SampleCounts,
    stochastic: bool,
) -> ErrorBoundedSamples:
    """Sample rays so that the error of the opacity is at most ε (`OPACITY_ERROR`; VolSDF Algorithm 1).

    A ray is cut uniformly. Then up to `counts.rounds` times cuts are added where they lower the error bound
    most (`bound_shares`), until the bound at β is ≤ ε. Each round queries the SDF at the new cuts only. A ray
    whose rounds are used up is sampled with the smallest scale β₊ > β for which the bound is ≤ ε.

    On a CPU a ray leaves the loop when it has converged (`can_leave_early`). On other devices all rays take
    all rounds, and a converged ray keeps β.

    Args:
        sdf: signed distance at points of the scene frame, negative inside.
        rays: the rays.
        interval: distances at which rays enter and leave the scene; near = far for a ray that misses it.
        beta: scale β of the density, scene units.
        counts: numbers of samples per ray.
        stochastic: whether the cuts and the samples are random; if False, they are central.
    """
    near, number = interval.near, len(rays)
    beta = beta.to(near.dtype).reshape(1, 1)
    samples = near.new_empty(number, counts.rendered)
    error_bound = torch.empty_like(near)

    rows = torch.arange(number, device=near.device)
    partition = first_cuts(sdf, rays, interval, counts.cuts, stochastic)
    queries = partition.distances.numel()
    # The bound at this scale is ≤ ε even if the surface touched every interval (VolSDF Lemma 2).
    worst = partition.width.square().sum(dim=-1, keepdim=True).div(4.0 * math.log1p(OPACITY_ERROR)).sqrt()
    beta_plus = torch.maximum(worst, beta)

    for rounds_left in reversed(range(counts.rounds + 1)):
        log_bound = log_error_bound(partition, beta)
        error_bound[rows] = log_bound[:, 0].exp().clamp_max(1.0)
        converged = log_bound <= math.log(OPACITY_ERROR)
        beta_plus = torch.where(converged, beta, beta_plus)
        if can_leave_early(near.device):
            done, left = converged[:, 0], ~converged[:, 0]
            samples[rows[done]] = opacity_samples(partition[done], beta_plus[done], counts, stochastic)
            rows, rays, partition, beta_plus = rows[left], rays[left], partition[left], beta_plus[left]
        beta_plus = bounded_beta(partition, beta, beta_plus)
        if rounds_left == 0 or len(rows) == 0:
            break
        shares = bound_shares(partition, beta_plus)
        partition = with_cuts(sdf, rays, partition, shares, counts.cuts, stochastic)
        queries += len(rows) * counts.cuts

    samples[rows] = opacity_samples(partition, beta_plus, counts, stochastic)
    return ErrorBoundedSamples(samples, error_bound, queries / max(number, 1))


def can_leave_early(device: torch.device) -> bool:
    """Whether converged rays are removed: on other devices than a CPU this would need a synchronisation."""
    return device.type == "cpu"


def opacity_samples(
    partition: Partition, beta: Float[Tensor, "N 1"], counts: SampleCounts, stochastic: bool
) -> Float[Tensor, "N {counts.rendered}"]:
    """Samples to render: both ends of each ray, and between them 2/3 by opacity and 1/3 spread over the cuts.

    Sampling by opacity inverts the partition's Ô, normalised to 1 at far (VolSDF Algorithm 1, last step).
    """
    distances = partition.distances
    density = laplace_density(partition.sdf[:, :-1], beta)
    mass = render_weights(density, distances[:, :-1], distances[:, -1]).weights
    within = samples_within(partition, mass, counts.rendered - 2, stochastic)
    return torch.cat([distances[:, :1], within, distances[:, -1:]], dim=-1)
