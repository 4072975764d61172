"""Where rays hit: depth, normal weights and concentration of a hit, blended from the samples of its ray."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from neilfpp_method.volume.compositing import Weights, sample_weights
from neilfpp_method.volume.density import DensityKind

__all__ = ["HIT_RADIUS", "BlendedHits", "blend_hits", "near_median", "share_near", "surface_depth"]

HIT_RADIUS = 0.05
"""The concentration of a hit is the rendering weight within this distance of it, scene units (METHOD §2)."""
SPARE_WEIGHT = 1e-6
"""Weight added to the last sample in the mean depth of a ray, so that it exists for an empty ray."""
MIN_SLOPE = 0.3
"""Smallest slope |dG/dt| by which a signed distance is divided. Where a ray meets the surface at less than
17°, its hit moves a part of the way to the zero set only.
"""


@dataclass(frozen=True)
class BlendedHits:
    """The hits of N rays with M samples each.

    Attributes:
        depth: distance along each ray, scene units.
        weights: weights with which the normals of the samples are blended; they need not add up to 1.
        concentration: rendering weight within `HIT_RADIUS` of the hit, without gradient.
    """

    depth: Float[Tensor, " N"]
    weights: Float[Tensor, "N M"]
    concentration: Float[Tensor, " N"]


def blend_hits(
    kind: DensityKind,
    directions: Float[Tensor, "N 3"],
    distances: Float[Tensor, "N M"],
    intervals: Weights,
    sdf: Float[Tensor, "N M"],
    gradient: Float[Tensor, "N M 3"],
) -> BlendedHits:
    """Blend the hit of each ray.

    With the isotropic density, as published, a hit is the mean of all samples. With the entering density it
    is the zero set of the surface that has the larger weight (`near_median`, `surface_depth`).

    Args:
        kind: the kind of density.
        directions: unit directions of the rays.
        distances: of the samples along the ray, ascending, scene units.
        intervals: rendering weights of the intervals between samples.
        sdf: signed distances G at the samples, scene units.
        gradient: ∇G at the samples.
    """
    weights = sample_weights(intervals.weights)
    if kind == "isotropic":
        depth = mean_depth(weights, distances)
    else:
        weights = weights * near_median(distances, intervals.weights, HIT_RADIUS)
        slope = (gradient * directions[:, None]).sum(-1)
        depth = surface_depth(weights, distances, sdf, slope)
    near = share_near(distances, intervals.weights.detach(), depth.detach(), HIT_RADIUS)
    return BlendedHits(depth, weights, near)


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
