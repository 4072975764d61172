"""Density from signed distance: the Laplace density of VolSDF (METHOD §3), and one that acts at entry only.

The density of VolSDF is isotropic, so the opacity of a ray grows with the length of its path through the
layer of a few β around a surface. With β = 0.005, a ray that passes a sphere of radius 0.5 at a distance of
3 β is half opaque, although a ray that hits the sphere head-on is so at the surface. Images fix where rays
become opaque, and most parts of an object form its outline in some image: their surface then lies too deep by
a few β.

The entering density acts only where the signed distance falls along the ray. The opacity of a ray then
depends on its smallest distance alone, from whichever direction it comes. It is the density of NeuS (Wang et
al. 2021) with the Laplace instead of the logistic distribution.

It needs a β well below the size of the objects, because a ray becomes opaque only several β inside. With β =
0.3 a ball of radius 0.8 grew to the whole scene; with the 0.05 of `fast` it kept its size.
"""

from __future__ import annotations

from typing import Literal

import torch
from jaxtyping import Float
from torch import Tensor, nn

from neilfpp_method.errors import UserError

__all__ = [
    "DensityKind",
    "LaplaceDensity",
    "depth_at",
    "entering_depth",
    "laplace_density",
    "laplace_depth",
    "optical_depth",
]

DensityKind = Literal["isotropic", "entering"]
"""That of VolSDF, or the one that acts only where a ray enters."""

SIMPSON_BELOW = 0.03
"""Difference of the signed distance over an interval, in units of β, below which Simpson's rule replaces the
divided difference. The latter loses digits there; the former is exact to 1e-5, even across the kink of the
density.
"""

BETA_FLOOR = 1e-4
"""Smallest β, scene units (VolSDF). Below it 128 samples per ray cannot find the surface."""


def laplace_density(sdf: Float[Tensor, "*shape"], beta: Float[Tensor, "*#shape"]) -> Float[Tensor, "*shape"]:
    """σ = α Ψ_β(−sdf), α = 1/β, Ψ_β the CDF of a zero-mean Laplace distribution (VolSDF eq. 2, 3).

    The density is 1/(2β) on the surface, 1/β deep inside and 0 far outside. All exponents are ≤ 0, so value
    and gradients are finite for any distance, and small densities keep their relative precision. 1/β² exceeds
    the range of float16 below β = 4e-3, so half precision is computed in float32.

    Args:
        sdf: signed distance, negative inside, scene units.
        beta: scale β > 0, scene units; one for all rays, or one per ray.

    Returns:
        Density, 1 / scene unit.
    """
    scaled = sdf.to(torch.promote_types(sdf.dtype, torch.float32)) / beta
    # Ψ(−x) = ½ (e^{−max(x, 0)} − expm1(min(x, 0))). relu has slope 0 at 0 and clamp_max slope 1, so
    # the slope of Ψ there is −½. scaled − outside would be NaN if the quotient overflows.
    outside, inside = torch.relu(scaled), scaled.clamp_max(0.0)
    density = 0.5 * (torch.exp(-outside) - torch.expm1(inside)) / beta
    return density.to(torch.result_type(sdf, beta))


def laplace_depth(
    sdf: Float[Tensor, "*shape M"], distances: Float[Tensor, "*shape M"], beta: Float[Tensor, "*#shape"]
) -> Float[Tensor, "*shape M-1"]:
    """Optical depth between neighbouring samples: the exact integral of the density for a linear SDF.

    With u = sdf/β an antiderivative of Ψ(−u) is F(u) = min(u, 0) − ½ e^{−|u|}, so an interval of width δ has
    the depth (δ/β) (F(u₁) − F(u₀)) / (u₁ − u₀). For a constant SDF this is δ σ.

    VolSDF uses δ times the density of the first sample instead. Rays that graze a surface are then too
    opaque, because the density of the last sample near the surface extends into the empty space behind it.

    Args:
        sdf: signed distance at the samples, scene units.
        distances: distances of the samples along the ray, ascending.
        beta: scale β > 0, scene units.

    Returns:
        Depths ≥ 0, in float32 or wider.

    Example:
        >>> sdf_on_surface = torch.zeros(2)  # the density is 1 / (2 β)
        >>> laplace_depth(sdf_on_surface, torch.tensor([0.0, 1.0]), torch.tensor(0.1))
        tensor([5.])
    """
    scaled = sdf.to(torch.promote_types(sdf.dtype, torch.float32)) / beta
    rise = _antiderivative_differences(scaled)
    step = scaled.diff(dim=-1)
    close = step.abs() < SIMPSON_BELOW
    # The divisor is 1 where the quotient is not used: an unused branch must not make the gradient NaN.
    quotient = rise / torch.where(close, torch.ones_like(step), step)
    one = torch.ones_like(beta)
    at_ends = laplace_density(scaled, one)
    middle = laplace_density(0.5 * (scaled[..., :-1] + scaled[..., 1:]), one)
    simpson = (at_ends[..., :-1] + 4.0 * middle + at_ends[..., 1:]) / 6.0
    # Rounding in a sampler can swap neighbouring samples by one unit in the last place: no negative widths.
    return torch.where(close, simpson, quotient) * distances.diff(dim=-1).clamp_min(0.0) / beta


def depth_at(sdf: Float[Tensor, "*shape"], beta: Float[Tensor, "*#shape"]) -> Float[Tensor, "*shape"]:
    """Optical depth −F(d/β) under the entering density of a ray along which G falls from afar to d = `sdf`.

    Returns:
        Depths > 0, in float32 or wider.

    Example:
        >>> depth_at(torch.tensor([0.0, -0.8]), torch.tensor(0.1))
        tensor([0.5000, 8.0002])
    """
    scaled = sdf.to(torch.promote_types(sdf.dtype, torch.float32)) / beta
    return 0.5 * torch.exp(-scaled.abs()) + torch.relu(-scaled)


def entering_depth(
    sdf: Float[Tensor, "*shape M"], beta: Float[Tensor, "*#shape"]
) -> Float[Tensor, "*shape M-1"]:
    """Optical depth between neighbouring samples of the density max(−dG/dt, 0) Ψ_β(−G) / β.

    Where G falls monotonically from G₀ to G₁ this is exactly F(G₀/β) − F(G₁/β), with F of `laplace_depth`,
    whatever the length of the interval; where G rises it is 0. Every ray is taken to come from far outside:
    the depth −F(G₀/β) before its first sample counts for its first interval. So matter in front of a camera
    is opaque, and a ray along which G falls to d and then rises has the depth −F(d/β) in total: e^{−d/β} / 2
    outside, 1/2 on the surface, and 8 at 8 β inside.

    Args:
        sdf: signed distance at the samples, scene units.
        beta: scale β > 0, scene units.

    Returns:
        Depths ≥ 0, in float32 or wider.

    Example:
        >>> sdf_along_ray = torch.tensor([10.0, 0.0, 10.0])  # the ray touches the surface
        >>> entering_depth(sdf_along_ray, torch.tensor(0.1))
        tensor([0.5000, 0.0000])
    """
    scaled = sdf.to(torch.promote_types(sdf.dtype, torch.float32)) / beta
    depth = torch.relu(-_antiderivative_differences(scaled))
    return torch.cat([depth_at(sdf[..., :1], beta) + depth[..., :1], depth[..., 1:]], dim=-1)


def optical_depth(
    kind: DensityKind,
    sdf: Float[Tensor, "*shape M"],
    distances: Float[Tensor, "*shape M"],
    beta: Float[Tensor, "*#shape"],
) -> Float[Tensor, "*shape M-1"]:
    """`laplace_depth` or `entering_depth`, by the kind of density."""
    return entering_depth(sdf, beta) if kind == "entering" else laplace_depth(sdf, distances, beta)


def _antiderivative_differences(scaled: Float[Tensor, "*shape M"]) -> Float[Tensor, "*shape M-1"]:
    """F(u₁) − F(u₀) of neighbouring u = sdf/β, with F(u) = min(u, 0) − ½ e^{−|u|}, F' = Ψ(−u)."""
    outside, inside = torch.relu(scaled), scaled.clamp_max(0.0)
    # The differences of both terms are taken separately: deep inside, the first term is large and would
    # absorb the second.
    return inside.diff(dim=-1) - 0.5 * torch.exp(inside - outside).diff(dim=-1)


class LaplaceDensity(nn.Module):
    """The learned scale of the Laplace density, β = |parameter| + floor (VolSDF).

    Args:
        beta_init: initial β, scene units.
        beta_floor: smallest β, scene units.

    Raises:
        UserError: the initial β is not above the floor, or the floor is not positive.
    """

    def __init__(self, beta_init: float, beta_floor: float = BETA_FLOOR) -> None:
        super().__init__()
        if not 0.0 < beta_floor < beta_init:
            raise UserError(
                f"host.volume.beta_init = {beta_init}: β must start above its floor, {beta_floor}, which "
                "must be above 0",
                f"choose a host.volume.beta_init above {BETA_FLOOR}",
            )
        self.beta_floor = beta_floor
        self.above_floor = nn.Parameter(torch.tensor(beta_init - beta_floor))

    def beta(self) -> Float[Tensor, ""]:
        """The scale β, scene units."""
        return self.above_floor.abs() + self.beta_floor

    @torch.no_grad()
    def limit_(self, beta: float) -> None:
        """Lower the scale to `beta` if it is larger; the floor stays."""
        largest = max(beta - self.beta_floor, 0.0)
        self.above_floor.clamp_(-largest, largest)
