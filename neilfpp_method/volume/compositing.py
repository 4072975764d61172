"""Adding up along a ray: emission and absorption (METHOD §3)."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from jaxtyping import Float
from torch import Tensor

__all__ = ["Weights", "composite", "depth_weights", "render_weights", "sample_weights", "share_near"]


@dataclass(frozen=True)
class Weights:
    """How much each interval, or sample, of a ray counts, what passes them all, and what they stop.

    Σ weights = opacity = 1 − transmittance; the opacity is accurate also where it is tiny.
    """

    weights: Float[Tensor, "N M"]
    transmittance: Float[Tensor, " N"]
    opacity: Float[Tensor, " N"]


def depth_weights(depth: Float[Tensor, "N K"]) -> Weights:
    """w_i = T_i (1 − exp(−τ_i)), T_i = exp(−Σ_{j<i} τ_j), for intervals of optical depth τ_i ≥ 0 (Max 1995).

    Optical depths are added before any exponential is taken, and 1 − exp is `expm1`: thin media keep their
    precision, opaque ones do not overflow. Half-precision inputs are added up in float32, and stay float32.
    """
    depth = depth.to(torch.promote_types(depth.dtype, torch.float32))
    # Summed afresh from a leading 0, not as "inclusive minus own": that cancels behind an opaque interval.
    depth_before = torch.nn.functional.pad(depth, (1, 0)).cumsum(dim=-1)
    weights = torch.exp(-depth_before[:, :-1]) * -torch.expm1(-depth)
    total = depth_before[:, -1]
    return Weights(weights, torch.exp(-total), -torch.expm1(-total))


def sample_weights(weights: Float[Tensor, "N K"]) -> Float[Tensor, "N K+1"]:
    """The weights of the samples at the ends of intervals: half of each interval's goes to either end.

    Example:
        >>> sample_weights(torch.tensor([[0.5, 0.2]]))
        tensor([[0.2500, 0.3500, 0.1000]])
    """
    return 0.5 * (torch.nn.functional.pad(weights, (1, 0)) + torch.nn.functional.pad(weights, (0, 1)))


def share_near(
    distances: Float[Tensor, "N M"],
    weights: Float[Tensor, "N M-1"],
    depth: Float[Tensor, " N"],
    radius: float,
) -> Float[Tensor, " N"]:
    """The weight of intervals within `radius` of a depth; partial intervals count in part."""
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
        far: where the last interval ends.
    """
    widths = torch.cat([distances, far[:, None]], dim=-1).diff(dim=-1)
    # Rounding in a sampler can swap neighbours by one unit in the last place; a negative width would emit.
    return depth_weights(
        density.to(torch.promote_types(density.dtype, torch.float32)) * widths.clamp_min(0.0)
    )


def composite(weights: Float[Tensor, "N M"], values: Float[Tensor, "N M C"]) -> Float[Tensor, "N C"]:
    """Σ_i w_i v_i for each ray, in the wider of the two types."""
    # Not a matrix product: automatic mixed precision would take that in half precision.
    return (weights[..., None] * values).sum(dim=-2)
