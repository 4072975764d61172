"""Emission-absorption compositing along rays (METHOD §3)."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float
from torch import Tensor

__all__ = [
    "HIT_RADIUS",
    "Weights",
    "composite",
    "depth_weights",
    "mean_depth",
    "near_median",
    "render_weights",
    "sample_weights",
    "share_near",
    "surface_depth",
]

HIT_RADIUS = 0.05
"""The concentration of a hit is the rendering weight within this distance of it, scene units (METHOD §2)."""
SPARE_WEIGHT = 1e-6
"""Weight added to the last sample in the mean depth of a ray, so that it exists for an empty ray."""
MIN_SLOPE = 0.3
"""Smallest slope |dG/dt| by which a signed distance is divided. Where a ray meets the surface at less than
17°, its hit moves a part of the way to the zero set only.
"""


@dataclass(frozen=True)
class Weights:
    """Rendering weights of the intervals of rays, with transmittance and opacity of each whole ray.

    Σ weights = opacity = 1 − transmittance. The opacity is computed separately, so tiny values are accurate.
    """

    weights: Float[Tensor, "N M"]
    transmittance: Float[Tensor, " N"]
    opacity: Float[Tensor, " N"]


def depth_weights(depth: Float[Tensor, "N K"]) -> Weights:
    """Rendering weights w_i = T_i (1 − exp(−τ_i)) with T_i = exp(−Σ_{j<i} τ_j) (Max 1995).

    Optical depths are summed before the exponential, and 1 − exp is computed by `expm1`: thin media keep
    their precision, and opaque ones do not overflow. Half-precision inputs are converted to float32.

    Args:
        depth: optical depths τ_i ≥ 0 of the intervals.
    """
    depth = depth.to(torch.promote_types(depth.dtype, torch.float32))
    # An exclusive sum, not the inclusive sum minus τ_i, which cancels behind an opaque interval.
    depth_before = torch.nn.functional.pad(depth, (1, 0)).cumsum(dim=-1)
    weights = torch.exp(-depth_before[:, :-1]) * -torch.expm1(-depth)
    total = depth_before[:, -1]
    return Weights(weights, torch.exp(-total), -torch.expm1(-total))


def sample_weights(weights: Float[Tensor, "N K"]) -> Float[Tensor, "N K+1"]:
    """Weights of samples at the ends of intervals: each interval gives half of its weight to either end.

    Example:
        >>> sample_weights(torch.tensor([[0.5, 0.2]]))
        tensor([[0.2500, 0.3500, 0.1000]])
    """
    return 0.5 * (torch.nn.functional.pad(weights, (1, 0)) + torch.nn.functional.pad(weights, (0, 1)))


def mean_depth(weights: Float[Tensor, "N M"], distances: Float[Tensor, "N M"]) -> Float[Tensor, " N"]:
    """Mean depth of the samples of each ray by their rendering weights; that of the last for an empty ray.

    Args:
        weights: rendering weights of the samples.
        distances: of the samples along the ray, scene units.
    """
    weighted = (weights * distances).sum(-1) + SPARE_WEIGHT * distances[:, -1]
    return weighted / (weights.sum(-1) + SPARE_WEIGHT)


def near_median(
    distances: Float[Tensor, "N M"], weights: Float[Tensor, "N M-1"], radius: float
) -> Bool[Tensor, "N M"]:
    """Samples around the median depth of each ray, at which half of its weight is reached.

    A ray that passes an edge meets two surfaces. The mean depth lies in the empty space between them, the
    median on the surface with the larger weight.

    Args:
        distances: ends of the intervals, ascending, scene units.
        weights: weights of the intervals.
        radius: largest distance from the farther end of the interval of the median, scene units.

    Returns:
        Which samples are near; both ends of the interval of the median always are.

    Example:
        >>> near_median(torch.tensor([[1.0, 1.1, 3.0, 3.1]]), torch.tensor([[0.6, 0.0, 0.4]]), 0.05)
        tensor([[ True,  True, False, False]])
    """
    reached = weights.cumsum(-1)
    median = (reached < 0.5 * reached[:, -1:]).sum(-1, keepdim=True)
    start, end = distances.gather(1, median), distances.gather(1, median + 1)
    return (distances >= start.clamp_max(end - radius)) & (distances <= end.clamp_min(start + radius))


def surface_depth(
    weights: Float[Tensor, "N M"],
    distances: Float[Tensor, "N M"],
    sdf: Float[Tensor, "N M"],
    slope: Float[Tensor, "N M"],
) -> Float[Tensor, " N"]:
    """Depth of the zero set along each ray: the mean depth of the samples, and one Newton step from there.

    The mean depth lies inside the surface, by a third of β where a ray meets it head-on: rays become opaque
    only there. The step is the mean signed distance over the mean slope, so it needs no query of the field. A
    mean outside stays: such a ray passes the surface, and need not meet it.

    Args:
        weights: rendering weights of the samples.
        distances: of the samples along the ray, scene units.
        sdf: signed distances G at the samples, scene units.
        slope: dG/dt along the ray at the samples.

    Returns:
        Depths between the first and the last sample, scene units; that of the last for a ray without weight.

    Example:
        >>> distances = torch.tensor([[1.0, 1.2]])  # around a surface at 1.05
        >>> surface_depth(torch.tensor([[0.5, 0.5]]), distances, 1.05 - distances, -torch.ones(1, 2))
        tensor([1.0500])
    """
    mean, opacity = mean_depth(weights, distances), weights.sum(-1)
    fall = torch.maximum(-(weights * slope).sum(-1), MIN_SLOPE * opacity)
    inside = (weights * sdf).sum(-1).clamp_max(0.0)
    depth = mean + inside / (fall + SPARE_WEIGHT)
    return torch.clamp(depth, distances[:, 0], distances[:, -1])


def share_near(
    distances: Float[Tensor, "N M"],
    weights: Float[Tensor, "N M-1"],
    depth: Float[Tensor, " N"],
    radius: float,
) -> Float[Tensor, " N"]:
    """Sum of the weights within `radius` of a depth along the ray; an interval that is cut counts in part.

    Args:
        distances: ends of the intervals, ascending.
        weights: weights of the intervals.
        depth: centre along each ray.
        radius: largest distance from the centre.
    """
    start = torch.maximum(distances[:, :-1], depth[:, None] - radius)
    end = torch.minimum(distances[:, 1:], depth[:, None] + radius)
    width = distances.diff(dim=-1).clamp_min(torch.finfo(distances.dtype).tiny)
    return (weights * ((end - start) / width).clamp(0.0, 1.0)).sum(-1)


def render_weights(
    density: Float[Tensor, "N M"], distances: Float[Tensor, "N M"], far: Float[Tensor, " N"]
) -> Weights:
    """`depth_weights` of piecewise constant density: τ_i = σ_i δ_i, δ_i = t_{i+1} − t_i.

    Args:
        density: σ_i ≥ 0 between sample i and the next, 1 / scene unit.
        distances: t_i, ascending.
        far: end of the last interval.
    """
    # Rounding in a sampler can swap neighbouring samples by one unit in the last place: no negative widths.
    widths = torch.cat([distances, far[:, None]], dim=-1).diff(dim=-1).clamp_min(0.0)
    return depth_weights(density.to(torch.promote_types(density.dtype, torch.float32)) * widths)


def composite(weights: Float[Tensor, "N M"], values: Float[Tensor, "N M C"]) -> Float[Tensor, "N C"]:
    """Σ_i w_i v_i for each ray, in the wider of the two types."""
    # Not a matrix product, which automatic mixed precision would compute in half precision.
    return (weights[..., None] * values).sum(dim=-2)
