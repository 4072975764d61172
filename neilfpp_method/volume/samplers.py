"""Where to sample a ray: evenly, by a distribution, or with bounded opacity error (VolSDF §3).

The error-bounded sampler cuts a ray into intervals, bounds how wrong the opacity can be when the density is
taken as constant on each, and cuts again where that bound comes from. Nothing here is differentiated.

The samples that are rendered are of two kinds (published code): most lie where a ray is stopped, and the
rest, with both ends of the ray, between them, so that the density is known where it is low as well. Without
the latter a ray that grazes a surface comes out too opaque.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass

import torch
from jaxtyping import Float
from torch import Tensor

from neilfpp_method.settings.types import VolumeConfig
from neilfpp_method.structures import Indexable, RayBatch
from neilfpp_method.volume.compositing import render_weights
from neilfpp_method.volume.density import laplace_density

__all__ = [
    "OPACITY_ERROR",
    "ErrorBoundedSamples",
    "error_bounded_samples",
    "inverse_cdf_samples",
    "uniform_samples",
]

OPACITY_ERROR = 0.1
"""ε, the bound on the opacity's error (VolSDF)."""

BISECTIONS = 10
"""Halvings of the interval in which β is sought (published code)."""

SPREAD = 1 / 3
"""Share of the samples that are spread over the cuts of a ray: 32 of 96 in the published code."""

SignedDistance = Callable[[Float[Tensor, "P 3"]], Float[Tensor, " P"]]


# -------------------------------------------------------------------------------------------- simple samplers


def strata(like: Float[Tensor, "N _"], count: int, stochastic: bool) -> Float[Tensor, "N {count}"]:
    """Ascending numbers in [0, 1], one in each of `count` equal strata: anywhere in it, or at its middle."""
    shape = (like.shape[0], count)
    within = like.new_empty(shape).uniform_() if stochastic else like.new_full(shape, 0.5)
    return (torch.arange(count, device=like.device, dtype=like.dtype) + within) / count


@torch.no_grad()
def uniform_samples(
    near: Float[Tensor, " N"], far: Float[Tensor, " N"], count: int, stochastic: bool
) -> Float[Tensor, "N {count}"]:
    """`count` ascending distances: both ends of [near, far], and one per equal part, random or central."""
    within = torch.lerp(near[:, None], far[:, None], strata(near[:, None], count - 2, stochastic))
    return torch.cat([near[:, None], within, far[:, None]], dim=-1)


@torch.no_grad()
def inverse_cdf_samples(
    edges: Float[Tensor, "N E"], mass: Float[Tensor, "N E-1"], count: int, stochastic: bool
) -> Float[Tensor, "N {count}"]:
    """Ascending distances distributed as `mass`, even within bins: one for each of `count` equal shares.

    A bin without mass gets no sample. Without any mass the samples are even from first to last edge.

    Args:
        edges: bounds of the bins, ascending; a bin may have no width.
        mass: how much of the distribution lies in each bin, ≥ 0, up to a common factor.
        count: samples per ray.
        stochastic: at random in each share, or at its middle.
    """
    tiny = torch.finfo(edges.dtype).tiny
    mass = mass.to(edges.dtype)
    total = mass.sum(dim=-1, keepdim=True)
    # The fallback is the widths, and at least `tiny`: an interval of no length is not divided by zero.
    mass = torch.where(total > tiny, mass / total.clamp_min(tiny), edges.diff(dim=-1).clamp_min(tiny))
    cdf = torch.nn.functional.pad(mass.cumsum(dim=-1), (1, 0))
    cdf = cdf / cdf[:, -1:]
    # With u below 1, the first edge whose CDF exceeds u closes a bin that has mass.
    u = strata(edges, count, stochastic).clamp_max(1.0 - torch.finfo(edges.dtype).eps)
    end = torch.searchsorted(cdf, u, right=True).clamp_max(mass.shape[-1])
    low, high = cdf.gather(-1, end - 1), cdf.gather(-1, end)
    # The clamps only matter where a parallel sum has rounded neighbours of the CDF out of order.
    fraction = ((u - low) / (high - low).clamp_min(tiny)).clamp(0.0, 1.0)
    return torch.lerp(edges.gather(-1, end - 1), edges.gather(-1, end), fraction)


# -------------------------------------------------------------------------------------------- the error bound


@dataclass(frozen=True)
class Partition(Indexable):
    """Rays cut into intervals: the E cuts from near to far, the SDF there, and each width and d*."""

    distances: Float[Tensor, "N E"]
    sdf: Float[Tensor, "N E"]
    width: Float[Tensor, "N E-1"]
    least_distance: Float[Tensor, "N E-1"]


def cut(distances: Float[Tensor, "N E"], sdf: Float[Tensor, "N E"]) -> Partition:
    """Rays cut at `distances`, where the SDF is `sdf`.

    d* is how close the surface can come to an interval (VolSDF Theorem 1 and supplement). The surface does
    not enter the balls of radius |sdf| about the ends of the interval; d* is the distance from the interval
    to what is outside both: to the circle where the spheres meet if its foot is in the interval, else the
    smaller radius. It is 0 where they do not meet, and where the sign changes: a learned distance may promise
    more room than there is.
    """
    width = distances.diff(dim=-1)
    start, end = sdf[:, :-1], sdf[:, 1:]
    a, b = start.abs(), end.abs()
    foot = 0.5 * (width + (a - b) * (a + b) / width.clamp_min(torch.finfo(width.dtype).tiny))
    foot = torch.minimum(foot.clamp_min(0.0), width)
    rest = width - foot
    squared = torch.minimum((a - foot) * (a + foot), (b - rest) * (b + rest)).clamp_min(0.0)
    return Partition(distances, sdf, width, torch.where(start * end > 0.0, squared.sqrt(), 0.0))


def optical_depth(partition: Partition, beta: Float[Tensor, "#N 1"]) -> Float[Tensor, "N K"]:
    """R̂ up to the start of each interval, with the density constant on each (VolSDF §3.3)."""
    depth = laplace_density(partition.sdf[:, :-1], beta) * partition.width
    return torch.nn.functional.pad(depth[:, :-1], (1, 0)).cumsum(dim=-1)


def depth_error(partition: Partition, beta: Float[Tensor, "#N 1"]) -> Float[Tensor, "N K"]:
    """Ê, the bound on the error of R̂, up to each interval's end: Σ δ² exp(−d*/β) / (4 β²) (VolSDF §3.3).

    The slope of the density is at most exp(−d*/β) / (2 β²) on an interval where |∇ sdf| ≤ 1 (Theorem 1).
    """
    share = torch.exp(-partition.least_distance / beta) * (partition.width / (2.0 * beta)).square()
    return share.cumsum(dim=-1)


def log_error_bound(partition: Partition, beta: Float[Tensor, "#N 1"]) -> Float[Tensor, "N 1"]:
    """Log of the bound on |O − Ô| along the ray: max_k exp(−R̂_k) (exp(Ê_{k+1}) − 1) (VolSDF Theorem 2).

    In logs, as exp(Ê) overflows where exp(−R̂) has long undone it.
    """
    error = depth_error(partition, beta)
    log_growth = error + torch.log(-torch.expm1(-error))
    return (log_growth - optical_depth(partition, beta)).amax(dim=-1, keepdim=True)


def bound_shares(partition: Partition, beta: Float[Tensor, "N 1"]) -> Float[Tensor, "N K"]:
    """What each interval adds to the bound, exp(Ê − R̂) · ΔÊ, up to a factor: where new cuts help.

    The paper cuts in proportion to the bound itself. That piles up along the ray: behind a grazed surface it
    stays high where nothing is to be gained. The shares reach the same bound with fewer queries.
    """
    log_share = (
        2.0 * partition.width.clamp_min(torch.finfo(beta.dtype).tiny).log() - partition.least_distance / beta
    )
    return torch.softmax(log_share + depth_error(partition, beta) - optical_depth(partition, beta), dim=-1)


def bounded_beta(
    partition: Partition, beta: Float[Tensor, "#N 1"], beta_plus: Float[Tensor, "N 1"], config: VolumeConfig
) -> Float[Tensor, "N 1"]:
    """The smallest scale in [β, β₊] found by bisection for which the bound is ≤ ε; β₊ where there is none.

    The steps halve the ratio, not the difference, of the ends: the two may lie decades apart.
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
    """Samples of each ray, their cost, and how far the opacity they follow can be from the truth.

    `distances` ascend. `error_bound` is that of `log_error_bound` at the true β, at most 1: above
    `OPACITY_ERROR` the rounds were used up, and the samples follow a wider density. It holds where
    |∇ sdf| ≤ 1. `sdf_queries` is the number of SDF queries per ray, a mean over the rays.
    """

    distances: Float[Tensor, "N M"]
    error_bound: Float[Tensor, " N"]
    sdf_queries: float


@torch.no_grad()
def error_bounded_samples(
    sdf: SignedDistance,
    origins: Float[Tensor, "N 3"],
    directions: Float[Tensor, "N 3"],
    near: Float[Tensor, " N"],
    far: Float[Tensor, " N"],
    beta: Float[Tensor, ""],
    config: VolumeConfig,
    stochastic: bool,
) -> ErrorBoundedSamples:
    """Distances where the Laplace density stops a ray, to `config.epsilon`, and some between (Algorithm 1).

    A ray is cut evenly, then up to `config.rounds` times where the bound on the error of its opacity comes
    from (`bound_shares`), until the bound at β is ≤ ε. Each round asks for the SDF at the new cuts only. A
    ray whose rounds are used up is sampled with the smallest wider scale β₊ that is bounded.

    A ray leaves the loop in the round in which it converges, where that is free (`can_leave_early`).
    Elsewhere all rays take all rounds, and a converged ray keeps β.

    Args:
        sdf: signed distance of points, negative inside, scene frame.
        origins, directions: the rays; unit directions.
        near, far: where they enter and leave the scene; near = far for a ray that misses it.
        beta: scale of the density, scene units.
        config: `initial_samples`, `rounds`, `samples`.
        stochastic: jitter the first cuts, the new cuts and the samples, or choose the middles.
    """
    rays = RayBatch(origins, directions)
    beta = beta.to(near.dtype).reshape(1, 1)
    samples = near.new_empty(len(rays), config.samples)
    error_bound = torch.empty_like(near)

    rows = torch.arange(len(rays), device=near.device)
    partition = first_cuts(sdf, rays, near, far, config.initial_samples, stochastic)
    queries = partition.distances.numel()
    # The bound at this scale is ≤ ε even if the surface touched every interval (VolSDF Lemma 2).
    worst = partition.width.square().sum(dim=-1, keepdim=True).div(4.0 * math.log1p(OPACITY_ERROR)).sqrt()
    beta_plus = torch.maximum(worst, beta)

    for rounds_left in reversed(range(config.rounds + 1)):
        log_bound = log_error_bound(partition, beta)
        error_bound[rows] = log_bound[:, 0].exp().clamp_max(1.0)
        converged = log_bound <= math.log(OPACITY_ERROR)
        beta_plus = torch.where(converged, beta, beta_plus)
        if can_leave_early(near.device):
            done, left = converged[:, 0], ~converged[:, 0]
            samples[rows[done]] = opacity_samples(
                partition[done], beta_plus[done], config.samples, stochastic
            )
            rows, rays, partition, beta_plus = rows[left], rays[left], partition[left], beta_plus[left]
        beta_plus = bounded_beta(partition, beta, beta_plus, config)
        if rounds_left == 0 or len(rows) == 0:
            break
        shares = bound_shares(partition, beta_plus)
        partition = with_cuts(sdf, rays, partition, shares, config.initial_samples, stochastic)
        queries += len(rows) * config.initial_samples

    samples[rows] = opacity_samples(partition, beta_plus, config.samples, stochastic)
    return ErrorBoundedSamples(samples, error_bound, queries / max(len(origins), 1))


def can_leave_early(device: torch.device) -> bool:
    """Whether the host may ask which rays have converged: a CPU knows; other devices would be waited for."""
    return device.type == "cpu"


def first_cuts(
    sdf: SignedDistance,
    rays: RayBatch,
    near: Float[Tensor, " N"],
    far: Float[Tensor, " N"],
    count: int,
    stochastic: bool,
) -> Partition:
    """`count` cuts: both ends of the interval, and evenly between."""
    distances = uniform_samples(near, far, count, stochastic)
    return cut(distances, query(sdf, rays, distances))


def with_cuts(
    sdf: SignedDistance,
    rays: RayBatch,
    partition: Partition,
    shares: Float[Tensor, "N K"],
    count: int,
    stochastic: bool,
) -> Partition:
    """The partition with `count` more cuts, in proportion to the shares of its intervals."""
    new = inverse_cdf_samples(partition.distances, shares, count, stochastic)
    distances, order = torch.cat([partition.distances, new], dim=-1).sort(dim=-1)
    return cut(distances, torch.cat([partition.sdf, query(sdf, rays, new)], dim=-1).gather(-1, order))


def query(sdf: SignedDistance, rays: RayBatch, distances: Float[Tensor, "N M"]) -> Float[Tensor, "N M"]:
    """Signed distance at distances along the rays, in the type of the distances."""
    points = rays.origins[:, None] + distances[..., None] * rays.directions[:, None]
    return sdf(points.reshape(-1, 3)).to(distances.dtype).reshape(distances.shape)


def opacity_samples(
    partition: Partition, beta: Float[Tensor, "N 1"], count: int, stochastic: bool
) -> Float[Tensor, "N {count}"]:
    """Both ends of each ray, between them two thirds of samples by opacity and one third over the cuts.

    By opacity: the inverse of the partition's Ô, normalised to 1 at far (VolSDF Algorithm 1, last step).
    """
    distances = partition.distances
    density = laplace_density(partition.sdf[:, :-1], beta)
    mass = render_weights(density, distances[:, :-1], distances[:, -1]).weights
    mass = mass / mass.sum(dim=-1, keepdim=True).clamp_min(torch.finfo(mass.dtype).tiny)
    mass = (1.0 - SPREAD) * mass + SPREAD / mass.shape[-1]
    within = inverse_cdf_samples(distances, mass, count - 2, stochastic)
    return torch.cat([distances[:, :1], within, distances[:, -1:]], dim=-1)
