"""From signed distance to density: the Laplace density of VolSDF (METHOD §3)."""

from __future__ import annotations

import torch
from jaxtyping import Float
from torch import Tensor, nn

from neilfpp_method.errors import UserError

__all__ = ["LaplaceDensity", "laplace_density", "laplace_depth"]

CLOSE = 0.03
"""Ends of an interval that differ by less than this share of β: their divided difference loses digits, and
Simpson's rule is exact to 1e-5 even across the kink of the density.
"""

BETA_FLOOR = 1e-4
"""The smallest β, scene units (VolSDF): below it a ray of 128 cuts cannot find the surface."""


def laplace_density(sdf: Float[Tensor, "*shape"], beta: Float[Tensor, "*#shape"]) -> Float[Tensor, "*shape"]:
    """σ = α Ψ_β(−sdf), α = 1/β, Ψ_β the CDF of a zero-mean Laplace distribution (VolSDF eq. 2, 3).

    Half of 1/β on the surface, 1/β deep inside, 0 far outside. No exponential grows, so value and gradients
    are finite for any distance; small densities outside keep their relative precision.

    Args:
        sdf: signed distance, negative inside, scene units.
        beta: scale > 0, scene units; one for all, or one per ray.

    Returns:
        Density, 1 / scene unit.
    """
    scaled = sdf / beta
    # Ψ(−x) = ½ (e^{−max(x, 0)} − expm1(min(x, 0))). relu has slope 0 at 0 and clamp_max slope 1, so
    # the slope of Ψ there is −½. scaled − outside would be NaN if the quotient overflows (float16).
    outside, inside = torch.relu(scaled), scaled.clamp_max(0.0)
    return 0.5 * (torch.exp(-outside) - torch.expm1(inside)) / beta


def laplace_depth(
    sdf: Float[Tensor, "*shape M"], distances: Float[Tensor, "*shape M"], beta: Float[Tensor, "*#shape"]
) -> Float[Tensor, "*shape M-1"]:
    """Optical depth between neighbouring samples of a ray: the density's integral, the SDF linear there.

    With u = sdf/β the antiderivative of Ψ(−u) is F(u) = min(u, 0) − ½ e^{−|u|}, so an interval of width δ has
    the depth (δ/β) (F(u₁) − F(u₀)) / (u₁ − u₀). An even cut of a homogeneous medium gives δ σ.

    The rule of VolSDF, δ times the density of the first sample, takes the last sample before empty space for
    all of it: rays that graze a surface come out too opaque.

    Args:
        sdf: signed distance at the samples, scene units.
        distances: of the samples, ascending.
        beta: scale > 0, scene units.

    Returns:
        Depths ≥ 0, in float32 or wider.

    Example:
        >>> along_a_surface = torch.zeros(2)  # its density is 1 / (2 β)
        >>> laplace_depth(along_a_surface, torch.tensor([0.0, 1.0]), torch.tensor(0.1))
        tensor([5.])
    """
    scaled = sdf.to(torch.promote_types(sdf.dtype, torch.float32)) / beta
    outside, inside = torch.relu(scaled), scaled.clamp_max(0.0)
    # The terms of F are subtracted apart: deep inside, the first is large and would absorb the second.
    rise = inside.diff(dim=-1) - 0.5 * torch.exp(inside - outside).diff(dim=-1)
    step = scaled.diff(dim=-1)
    close = step.abs() < CLOSE
    # A divisor of 1 where the quotient is not used: an unused branch must not send NaN to the gradient.
    quotient = rise / torch.where(close, torch.ones_like(step), step)
    one = torch.ones_like(beta)
    at_ends = laplace_density(scaled, one)
    middle = laplace_density(0.5 * (scaled[..., :-1] + scaled[..., 1:]), one)
    simpson = (at_ends[..., :-1] + 4.0 * middle + at_ends[..., 1:]) / 6.0
    # Rounding in a sampler can swap neighbours by one unit in the last place; a negative width would emit.
    return torch.where(close, simpson, quotient) * distances.diff(dim=-1).clamp_min(0.0) / beta


class LaplaceDensity(nn.Module):
    """The Laplace density with a learned scale β = |parameter| + floor (VolSDF).

    Args:
        beta_init: β at the start, scene units.
        beta_floor: the smallest β.

    Raises:
        UserError: β would start at its floor, or below, where it cannot move, or the floor is not positive.
    """

    def __init__(self, beta_init: float, beta_floor: float = BETA_FLOOR) -> None:
        super().__init__()
        if not 0.0 < beta_floor < beta_init:
            raise UserError(
                f"volume.beta_init = {beta_init}: β must start above its floor, {beta_floor}, which must be "
                "above 0",
                f"choose a volume.beta_init above {BETA_FLOOR}",
            )
        self.beta_floor = beta_floor
        self.above_floor = nn.Parameter(torch.tensor(beta_init - beta_floor))

    def beta(self) -> Float[Tensor, ""]:
        """The scale of the density, scene units."""
        return self.above_floor.abs() + self.beta_floor

    def forward(self, sdf: Float[Tensor, "N M"], distances: Float[Tensor, "N M"]) -> Float[Tensor, "N M-1"]:
        """Optical depth between the samples of rays; see `laplace_depth`."""
        return laplace_depth(sdf, distances, self.beta())
