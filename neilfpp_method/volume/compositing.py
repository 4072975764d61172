"""Adding up along a ray: emission and absorption with piecewise constant density (METHOD §3)."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from jaxtyping import Float
from torch import Tensor

__all__ = ["Weights", "composite", "optical_depth", "render_weights"]


@dataclass(frozen=True)
class Weights:
    """How much each sample of a ray counts, what passes them all, and what they stop.

    Σ weights = opacity = 1 − transmittance; the opacity is accurate also where it is tiny.
    """

    weights: Float[Tensor, "N M"]
    transmittance: Float[Tensor, " N"]
    opacity: Float[Tensor, " N"]


def render_weights(density: Float[Tensor, "N M"], distances: Float[Tensor, "N M"], far: Float[Tensor, " N"]) -> Weights:
    """w_i = T_i (1 − exp(−σ_i δ_i)), T_i = exp(−Σ_{j<i} σ_j δ_j), δ_i = t_{i+1} − t_i (Max 1995).

    Optical depths are added before any exponential is taken, and 1 − exp is `expm1`: thin media keep their precision,
    opaque ones do not overflow. Half-precision inputs are added up in float32, and stay float32.

    Args:
        density: σ_i ≥ 0 between sample i and the next, 1 / scene unit.
        distances: t_i, ascending.
        far: where the last interval ends.
    """
    widths = torch.cat([distances, far[:, None]], dim=-1).diff(dim=-1)
    # Rounding in a sampler can swap neighbours by one unit in the last place; a negative width would emit.
    depth = density.to(torch.promote_types(density.dtype, torch.float32)) * widths.clamp_min(0.0)
    # Summed afresh from a leading 0, not as "inclusive minus own": that cancels behind an opaque interval.
    depth_before = torch.nn.functional.pad(depth, (1, 0)).cumsum(dim=-1)
    weights = torch.exp(-depth_before[:, :-1]) * -torch.expm1(-depth)
    total = depth_before[:, -1]
    return Weights(weights, torch.exp(-total), -torch.expm1(-total))


def optical_depth(density: Float[Tensor, "N M"], distances: Float[Tensor, "N M"]) -> Float[Tensor, " N"]:
    """τ = Σ σ_i δ_i from the first sample of a ray to the last."""
    return (density[:, :-1] * distances.diff(dim=-1).clamp_min(0.0)).sum(-1)


def composite(weights: Float[Tensor, "N M"], values: Float[Tensor, "N M C"]) -> Float[Tensor, "N C"]:
    """Σ_i w_i v_i for each ray, in the wider of the two types."""
    # Not a matrix product: automatic mixed precision would take that in half precision.
    return (weights[..., None] * values).sum(dim=-2)
