"""Rays that are cut into intervals, from which samplers choose the samples to render.

The rendered samples are of two kinds (published code): most are distributed by opacity, and the rest, with
both ends of the ray, is spread over the whole ray, so that the density is also sampled where it is low.
Without the latter a ray that grazes a surface would be rendered too opaque.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import torch
from jaxtyping import Float
from torch import Tensor

from neilfpp_method.settings.types import VolumeConfig
from neilfpp_method.stratified.intervals import inverse_cdf_samples, uniform_samples
from neilfpp_method.structures import Indexable, RayBatch
from neilfpp_method.volume.distance_grid import SignedDistance
from neilfpp_method.volume.intersect import Interval

__all__ = [
    "SPREAD_SHARE",
    "Partition",
    "SampleCounts",
    "cut",
    "first_cuts",
    "sample_counts",
    "samples_within",
    "with_cuts",
]

SPREAD_SHARE = 1 / 3
"""Share of the rendered samples that are spread over the cuts of a ray: 32 of 96 in the published code."""

CUTS, ROUNDS = 128, 5
"""Cuts per ray in each round, and maximum number of refinement rounds (VolSDF Algorithm 1)."""
SKIPPING_CUTS, SKIPPING_ROUNDS = 64, 2
"""The same if rays skip empty space: what is left of them is short."""


@dataclass(frozen=True)
class SampleCounts:
    """Numbers of samples per ray.

    Attributes:
        cuts: SDF queries in the first round of a sampler and in each refinement round.
        rounds: maximum number of refinement rounds of `error_bounded_samples`.
        rendered: samples that are rendered.
    """

    cuts: int
    rounds: int
    rendered: int

    def of_narrowed_rays(self) -> SampleCounts:
        """The counts for rays of which only the part that is not empty is sampled: half as many cuts."""
        return replace(self, cuts=self.cuts // 2)


def sample_counts(config: VolumeConfig) -> SampleCounts:
    """The counts that suit the settings, for whole rays."""
    cuts, rounds = (SKIPPING_CUTS, SKIPPING_ROUNDS) if config.skip_empty else (CUTS, ROUNDS)
    return SampleCounts(cuts, rounds, config.samples)


@dataclass(frozen=True)
class Partition(Indexable):
    """Rays cut into intervals: distances of the E cuts, the SDF there, and width and d* of each interval."""

    distances: Float[Tensor, "N E"]
    sdf: Float[Tensor, "N E"]
    width: Float[Tensor, "N E-1"]
    least_distance: Float[Tensor, "N E-1"]


def cut(distances: Float[Tensor, "N E"], sdf: Float[Tensor, "N E"]) -> Partition:
    """Make a partition of rays from the distances of the cuts and the SDF there.

    d* is a lower bound on the distance between the surface and an interval (VolSDF Theorem 1 and supplement).
    The surface does not enter the balls of radius |sdf| around the ends of the interval. d* is the distance
    from the interval to the outside of both balls: to the circle in which the spheres intersect if its
    projection lies in the interval, else the smaller radius. It is 0 if the spheres do not intersect, or if
    the sign changes, which is possible as learned distances may be too large.
    """
    width = distances.diff(dim=-1)
    start, end = sdf[:, :-1], sdf[:, 1:]
    a, b = start.abs(), end.abs()
    foot = 0.5 * (width + (a - b) * (a + b) / width.clamp_min(torch.finfo(width.dtype).tiny))
    foot = torch.minimum(foot.clamp_min(0.0), width)
    rest = width - foot
    squared = torch.minimum((a - foot) * (a + foot), (b - rest) * (b + rest)).clamp_min(0.0)
    return Partition(distances, sdf, width, torch.where(start * end > 0.0, squared.sqrt(), 0.0))


def first_cuts(
    sdf: SignedDistance, rays: RayBatch, interval: Interval, count: int, stochastic: bool
) -> Partition:
    """Cut rays uniformly by `count` cuts, both ends included."""
    distances = uniform_samples(interval.near, interval.far, count, stochastic)
    return cut(distances, _query(sdf, rays, distances))


def with_cuts(
    sdf: SignedDistance,
    rays: RayBatch,
    partition: Partition,
    shares: Float[Tensor, "N K"],
    count: int,
    stochastic: bool,
) -> Partition:
    """Add `count` cuts to a partition, distributed by the shares of its intervals."""
    new = inverse_cdf_samples(partition.distances, shares, count, stochastic)
    distances, order = torch.cat([partition.distances, new], dim=-1).sort(dim=-1)
    return cut(distances, torch.cat([partition.sdf, _query(sdf, rays, new)], dim=-1).gather(-1, order))


def _query(sdf: SignedDistance, rays: RayBatch, distances: Float[Tensor, "N M"]) -> Float[Tensor, "N M"]:
    """Signed distance at points along the rays, in the type of the distances."""
    points = rays.origins[:, None] + distances[..., None] * rays.directions[:, None]
    return sdf(points.reshape(-1, 3)).to(distances.dtype).reshape(distances.shape)


def samples_within(
    partition: Partition, mass: Float[Tensor, "N K"], count: int, stochastic: bool
) -> Float[Tensor, "N {count}"]:
    """Samples to render between the ends of rays: 2/3 by `mass`, and 1/3 spread over the cuts.

    Args:
        partition: the rays.
        mass: opacity of each interval, up to a common factor per ray.
        count: samples per ray.
        stochastic: whether samples are random within their share of the mass; if False, they are central.
    """
    mass = mass / mass.sum(dim=-1, keepdim=True).clamp_min(torch.finfo(mass.dtype).tiny)
    mass = (1.0 - SPREAD_SHARE) * mass + SPREAD_SHARE / mass.shape[-1]
    return inverse_cdf_samples(partition.distances, mass, count, stochastic)
