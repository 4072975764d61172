"""Sample directions in proportion to an environment map times the cosine at each surface point.

The product is the integrand of irradiance. A diffuse surface that nothing occludes therefore has almost no
noise, and hardly any sample is wasted below the horizon. Sampling takes two steps, so that its cost does not
grow with the size of the map: first a cell of neighbouring texels, in proportion to the power of the cell
times the cosine at its centre, then a texel of the cell in proportion to its power.
"""

from __future__ import annotations

import functools
import math
from dataclasses import dataclass

import torch
from jaxtyping import Float, Int
from torch import Tensor

from neilfpp_method.fields.direction_map import (
    directions_within,
    texel_centers,
    texel_solid_angles,
    texels_of,
)
from neilfpp_method.shading.frame import at_least_float32
from neilfpp_method.shading.sampling import Technique
from neilfpp_method.stratified.intervals import strata

__all__ = ["radiance_times_cosine"]

CELL_ROWS = 24
"""Maximum number of rows of cells: 1152 cells, which are 8° high. The cosine changes little within a cell."""
BELOW_ONE = 1 - 1e-6
"""Upper bound on a share of a cumulative sum, so that rounding cannot select a cell of probability 0."""


@dataclass(frozen=True)
class _Cells:
    """The C cells of a map with T texels.

    Attributes:
        of_texel: cell of each texel.
        order: the texels, cell by cell.
        first: position in `order` of the first texel of each cell.
        last: position in `order` of the last texel of each cell.
        center: unit direction of the centre of each cell.
        radius: upper bound on the angle between a centre and a direction of its cell, radians.
        solid_angle: solid angle of each texel, sr.
    """

    of_texel: Int[Tensor, " T"]
    order: Int[Tensor, " T"]
    first: Int[Tensor, " C"]
    last: Int[Tensor, " C"]
    center: Float[Tensor, "C 3"]
    radius: float
    solid_angle: Float[Tensor, " T"]


@torch.no_grad()
def radiance_times_cosine(share: Float[Tensor, "H W"], normal: Float[Tensor, "N 3"]) -> Technique:
    """Sampling in proportion to the power of texels times the cosine about a normal.

    Args:
        share: share of each texel in the radiance of the map integrated over solid angle; positive.
        normal: unit normals.

    Returns:
        The technique; its density is positive in all directions above the horizon, and constant on a texel.
    """
    height, width = share.shape
    normal = at_least_float32(normal)
    share = share.reshape(-1).to(normal)
    cells = _cells(height, width, share.device)
    power = share.new_zeros(len(cells.center)).index_add(0, cells.of_texel, share)
    # A cell that the horizon cuts has a positive weight, because some of its directions are above.
    cosine = normal @ cells.center.to(normal).t() + math.sin(cells.radius)
    probability = power * cosine.clamp_min(0)
    probability = probability / probability.sum(1, keepdim=True)
    texel_power = share[cells.order].cumsum(0)

    def draw(count: int, stochastic: bool) -> Float[Tensor, "N S 3"]:
        u = strata(normal, count, stochastic)
        up_to = probability.cumsum(1)
        target = (u * up_to[:, -1:]).minimum(up_to[:, -1:] * BELOW_ONE)
        cell = torch.searchsorted(up_to, target, right=True).clamp_max(len(power) - 1)
        chosen = probability.gather(1, cell)
        # The position within the cell's interval of the cumulative sum selects the texel of the cell.
        within = ((target - up_to.gather(1, cell) + chosen) / chosen.clamp_min(1e-30)).clamp(0, BELOW_ONE)
        before = texel_power[cells.last[cell]] - power[cell]
        position = torch.searchsorted(texel_power, before + within * power[cell], right=True)
        texel = cells.order[position.maximum(cells.first[cell]).minimum(cells.last[cell])]
        shares = torch.rand(2, *u.shape).to(u) if stochastic else u.new_full((2, *u.shape), 0.5)
        return directions_within(texel, shares[0], shares[1], height, width)

    def pdf(wi: Float[Tensor, "N S 3"]) -> Float[Tensor, "N S"]:
        texel = texels_of(wi, height, width)
        cell = cells.of_texel[texel]
        return probability.gather(1, cell) * (share / cells.solid_angle)[texel] / power[cell]

    return Technique(draw, pdf)


@functools.lru_cache(maxsize=8)
@torch.inference_mode(False)
def _cells(height: int, width: int, device: torch.device) -> _Cells:
    """Group the texels of a map of this size into cells of side × side texels."""
    side = math.ceil(height / CELL_ROWS)
    texel = torch.arange(height * width, device=device)
    columns = math.ceil(width / side)
    of_texel = texel // width // side * columns + texel % width // side
    order = of_texel.argsort(stable=True)
    size = of_texel.bincount()
    last = size.cumsum(0) - 1
    directions = texel_centers(height, width, device)
    center = torch.zeros(len(size), 3, device=device).index_add(0, of_texel, directions)
    center = torch.nn.functional.normalize(center, dim=-1)
    # A texel reaches at most half its height and width beyond its centre.
    to_center = (directions * center[of_texel]).sum(-1).clamp(-1, 1).acos().max().item()
    half = math.hypot(math.pi / (height - 1), 2 * math.pi / width) / 2
    radius = min(to_center + half, math.pi / 2)
    solid_angle = texel_solid_angles(height, width, device)
    return _Cells(of_texel, order, last - size + 1, last, center, radius, solid_angle)
