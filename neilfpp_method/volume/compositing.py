"""Emission-absorption compositing along rays (METHOD §3)."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from jaxtyping import Float
from torch import Tensor

__all__ = [
    "Weights",
    "composite",
    "depth_weights",
    "render_weights",
    "sample_weights",
]


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
