"""Stratified samples of [0, 1], of an interval, and of a piecewise constant distribution.

Each is random in its stratum or, without `stochastic`, at the middle of it. Samples have no gradient.
"""

from __future__ import annotations

import torch
from jaxtyping import Float
from torch import Tensor

__all__ = ["inverse_cdf_samples", "strata", "uniform_samples"]


def strata(like: Float[Tensor, "N _"], count: int, stochastic: bool) -> Float[Tensor, "N S"]:
    """Ascending numbers in [0, 1], one in each of `count` equal strata, for each row of a tensor.

    Args:
        like: a tensor with N rows; the result has its device and type.
        count: the number S of strata.
        stochastic: whether a number is random in its stratum; otherwise it is the midpoint.

    Example:
        >>> strata(torch.zeros(1, 3), 4, stochastic=False)
        tensor([[0.1250, 0.3750, 0.6250, 0.8750]])
    """
    k = torch.arange(count, device=like.device, dtype=like.dtype).expand(len(like), count)
    return (k + (torch.rand_like(k) if stochastic else 0.5)) / count


@torch.no_grad()
def uniform_samples(
    near: Float[Tensor, " N"], far: Float[Tensor, " N"], count: int, stochastic: bool
) -> Float[Tensor, "N {count}"]:
    """`count` ascending numbers: near, far, and one in each equal part between, random or central."""
    within = torch.lerp(near[:, None], far[:, None], strata(near[:, None], count - 2, stochastic))
    return torch.cat([near[:, None], within, far[:, None]], dim=-1)


@torch.no_grad()
def inverse_cdf_samples(
    edges: Float[Tensor, "N E"], mass: Float[Tensor, "N E-1"], count: int, stochastic: bool
) -> Float[Tensor, "N {count}"]:
    """Stratified samples of a piecewise constant distribution, in ascending order.

    A bin without mass gets no sample. If all bins are without mass, samples are uniform from the first to the
    last edge.

    Args:
        edges: bounds of the bins, ascending; a bin may have width 0.
        mass: probability mass of each bin, ≥ 0, up to a common factor.
        count: samples per row, one in each of `count` equal shares of the mass.
        stochastic: whether samples are random within their share; if False, they are at its centre.
    """
    tiny = torch.finfo(edges.dtype).tiny
    mass = mass.to(edges.dtype)
    total = mass.sum(dim=-1, keepdim=True)
    # Without mass, use the widths, at least `tiny` against a division by zero if all of them are 0.
    mass = torch.where(total > tiny, mass / total.clamp_min(tiny), edges.diff(dim=-1).clamp_min(tiny))
    cdf = torch.nn.functional.pad(mass.cumsum(dim=-1), (1, 0))
    cdf = cdf / cdf[:, -1:]
    # With u below 1, the first edge whose CDF exceeds u closes a bin that has mass.
    u = strata(edges, count, stochastic).clamp_max(1.0 - torch.finfo(edges.dtype).eps)
    end = torch.searchsorted(cdf, u, right=True).clamp_max(mass.shape[-1])
    low, high = cdf.gather(-1, end - 1), cdf.gather(-1, end)
    # The clamps only matter if a parallel sum has rounded neighbouring values of the CDF out of order.
    fraction = ((u - low) / (high - low).clamp_min(tiny)).clamp(0.0, 1.0)
    return torch.lerp(edges.gather(-1, end - 1), edges.gather(-1, end), fraction)
