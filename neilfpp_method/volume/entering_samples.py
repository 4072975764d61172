"""The sampler of distances along rays for the entering density (`volume.density`).

The opacity of a ray under this density depends on its smallest signed distance alone, and between two samples
it is known exactly. So the sampler needs no bound on the error of a quadrature, as VolSDF's does: it cuts a
ray, and then adds cuts where the ray may become opaque.
"""

from __future__ import annotations

import torch
from jaxtyping import Float
from torch import Tensor

from neilfpp_method.structures import RayBatch
from neilfpp_method.volume.compositing import depth_weights
from neilfpp_method.volume.density import depth_at, entering_depth
from neilfpp_method.volume.distance_grid import SignedDistance
from neilfpp_method.volume.intersect import Interval
from neilfpp_method.volume.partition import Partition, SampleCounts, first_cuts, samples_within, with_cuts

__all__ = ["entering_samples", "possible_weights"]

ROUNDS = 2
"""Number of rounds in which cuts are added. With as many cuts in one round, the mean error of the opacity of
a thin wire is two to three times as large (in the scene of `tests/volume/test_entering_samples.py`).
"""


@torch.no_grad()
def entering_samples(
    sdf: SignedDistance,
    rays: RayBatch,
    interval: Interval,
    beta: Float[Tensor, ""],
    counts: SampleCounts,
    stochastic: bool,
) -> Float[Tensor, "N {counts.rendered}"]:
    """Distances to render: both ends of each ray, the cut nearest to the surface, and samples by opacity.

    A ray costs two queries of the field per cut in `counts`: one in the first round, one in the others.

    Args:
        sdf: signed distance at points of the scene frame, negative inside.
        rays: the rays.
        interval: distances at which rays enter and leave the scene; near = far for a ray that misses it.
        beta: scale β of the density, scene units.
        counts: numbers of samples per ray.
        stochastic: whether the cuts and the samples are random; if False, they are central.

    Returns:
        Ascending distances.
    """
    beta = beta.to(interval.near.dtype)
    partition = first_cuts(sdf, rays, interval, counts.cuts, stochastic)
    for _ in range(ROUNDS):
        shares = possible_weights(partition, beta)
        partition = with_cuts(sdf, rays, partition, shares, counts.cuts // ROUNDS, stochastic)
    distances = partition.distances
    weights = depth_weights(entering_depth(partition.sdf, beta)).weights
    by_opacity = samples_within(partition, weights, counts.rendered - 3, stochastic)
    nearest = distances.gather(-1, partition.sdf.argmin(dim=-1, keepdim=True))
    within = torch.cat([by_opacity, nearest], dim=-1).sort(dim=-1).values
    return torch.cat([distances[:, :1], within, distances[:, -1:]], dim=-1)


def possible_weights(partition: Partition, beta: Float[Tensor, ""]) -> Float[Tensor, "N K"]:
    """The largest rendering weight that each interval can have if the slope of the field is at most 1.

    The smallest signed distance in an interval is at least the smaller one of its ends and d* (`cut`) if it
    is outside for certain. Else it is at least that of the deepest object between both ends, so cuts are also
    added where a thin object may be.
    """
    start, end = partition.sdf[:, :-1], partition.sdf[:, 1:]
    is_outside = (partition.least_distance > 0.0) & (start > 0.0)
    deepest = 0.5 * (start + end - partition.width)
    nearest = torch.minimum(torch.minimum(start, end), partition.least_distance)
    lowest = torch.where(is_outside, nearest, torch.minimum(nearest, deepest))
    # A ray that has become opaque before an interval has no weight left for it.
    before = torch.nn.functional.pad(entering_depth(partition.sdf, beta), (1, 0)).cumsum(dim=-1)[:, :-1]
    return torch.exp(-before) * -torch.expm1(-depth_at(lowest, beta))
