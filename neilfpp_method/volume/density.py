"""From signed distance to density: the Laplace density of VolSDF (METHOD §3)."""

from __future__ import annotations

import torch
from jaxtyping import Float
from torch import Tensor, nn

from neilfpp_method.errors import UserError

__all__ = ["LaplaceDensity", "laplace_density"]

BETA_FLOOR = 1e-4
"""The smallest β, scene units (VolSDF): below it a ray of 128 cuts cannot find the surface."""


def laplace_density(sdf: Float[Tensor, "*shape"], beta: Float[Tensor, "*#shape"]) -> Float[Tensor, "*shape"]:
    """σ = α Ψ_β(−sdf), α = 1/β, with Ψ_β the CDF of a zero-mean Laplace distribution of scale β (VolSDF eq. 2, 3).

    Half of 1/β on the surface, 1/β deep inside, 0 far outside. No exponential grows, so value and gradients are finite
    for any distance; small densities outside keep their relative precision.

    Args:
        sdf: signed distance, negative inside, scene units.
        beta: scale > 0, scene units; one for all, or one per ray.

    Returns:
        Density, 1 / scene unit.
    """
    scaled = sdf / beta
    # Ψ(−x) = ½ (e^{−max(x, 0)} − expm1(min(x, 0))). The parts share the kink so that the slope at 0 is −½, not 0 or −1.
    outside = torch.relu(scaled)
    inside = scaled - outside
    return 0.5 * (torch.exp(-outside) - torch.expm1(inside)) / beta


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
                f"volume.beta_init = {beta_init}: β must start above its floor, {beta_floor}, which must be above 0",
                f"choose a volume.beta_init above {BETA_FLOOR}",
            )
        self.beta_floor = beta_floor
        self.above_floor = nn.Parameter(torch.tensor(beta_init - beta_floor))

    def beta(self) -> Float[Tensor, ""]:
        """The scale of the density, scene units."""
        return self.above_floor.abs() + self.beta_floor

    def forward(self, sdf: Float[Tensor, "*shape"]) -> Float[Tensor, "*shape"]:
        """Density at signed distance `sdf`; see `laplace_density`."""
        return laplace_density(sdf, self.beta())
