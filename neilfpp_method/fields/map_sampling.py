"""Sample directions in proportion to an environment map times the cosine at each surface point.

The product is the integrand of irradiance. A diffuse surface that nothing occludes therefore has almost no
noise, and few samples are wasted below the horizon. Sampling takes three steps, so that its cost does not
grow with the size of the map: first a cell of neighbouring texels, in proportion to the power of the cell
times the cosine at its centre; then a texel of the cell in proportion to its power; then a direction in
proportion to the weight of the texel in the interpolation of the map.

Each texel has power in all directions to whose interpolated radiance it contributes: up to the middles of the
texels around it. Sampled uniformly within texels, a sun of one texel would have noise of 25 % from the slopes
of the interpolation alone, with 12 directions.
"""

from __future__ import annotations

import functools
import math
from dataclasses import dataclass

import torch
from jaxtyping import Float, Int
from torch import Tensor

from neilfpp_method.fields.direction_map import (
    direction_at,
    interpolation_solid_angles,
    map_directions,
    polar_cosines,
    weights_linear_in_cosine,
)
from neilfpp_method.shading.frame import at_least_float32
from neilfpp_method.shading.sampling import Lattice, Technique

__all__ = ["radiance_times_cosine"]

CELL_ROWS = 24
"""Maximum number of rows of cells: 1152 cells, which are 8° high. The cosine changes little within a cell."""
AT_HORIZON = 0.25
"""Weight of a cell relative to the largest cosine within it, for cells of which little is above the horizon.
With 1, more samples would be wasted below the horizon; with less, those above it would have larger weights.
"""
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
        radius: upper bound on the angle between a centre and a direction to which a texel of its cell
            contributes, radians.
    """

    of_texel: Int[Tensor, " T"]
    order: Int[Tensor, " T"]
    first: Int[Tensor, " C"]
    last: Int[Tensor, " C"]
    center: Float[Tensor, "C 3"]
    radius: float


@torch.no_grad()
def radiance_times_cosine(luminance: Float[Tensor, "H W"], normal: Float[Tensor, "N 3"]) -> Technique:
    """Sampling in proportion to an interpolated map times the cosine about a normal.

    Args:
        luminance: luminance of each texel up to a common factor, positive. Between texels it is linear in the
            azimuth and in the cosine of the polar angle. `direction_map.interpolate` is linear in the polar
            angle itself; the two differ by a factor of at most 2, at the poles.
        normal: unit normals.

    Returns:
        The technique; its density is positive in all directions above the horizon.
    """
    height, width = luminance.shape
    normal = at_least_float32(normal)
    texels = luminance.reshape(-1).to(normal)
    cells = _cells(height, width, texels.device)
    solid_angle = interpolation_solid_angles(height, width, texels.device).to(normal)
    share = texels * solid_angle / (texels @ solid_angle)
    power = share.new_zeros(len(cells.center)).index_add(0, cells.of_texel, share)
    cosine = normal @ cells.center.to(normal).t()
    # A cell that the horizon cuts has a positive weight, because some of its directions are above.
    weight = cosine.maximum(AT_HORIZON * (cosine + math.sin(cells.radius))).clamp_min(0)
    probability = power * weight
    probability = probability / probability.sum(1, keepdim=True)
    texel_power = share[cells.order].cumsum(0)
    # Density of a texel, per sr, at its middle, given its cell.
    at_middle = share / solid_angle / power[cells.of_texel]

    def place(at: Lattice) -> Float[Tensor, "N S 3"]:
        up_to = probability.cumsum(1)
        target = (at.u * up_to[:, -1:]).minimum(up_to[:, -1:] * BELOW_ONE)
        cell = torch.searchsorted(up_to, target, right=True).clamp_max(len(power) - 1)
        chosen = probability.gather(1, cell)
        # The position within the cell's interval of the cumulative sum selects the texel of the cell.
        within = ((target - up_to.gather(1, cell) + chosen) / chosen.clamp_min(1e-30)).clamp(0, BELOW_ONE)
        before = texel_power[cells.last[cell]] - power[cell]
        position = torch.searchsorted(texel_power, before + within * power[cell], right=True)
        texel = cells.order[position.maximum(cells.first[cell]).minimum(cells.last[cell])]
        return _around(texel, at.w, at.v, height, width)

    def pdf(wi: Float[Tensor, "N S 3"]) -> Float[Tensor, "N S"]:
        total = torch.zeros_like(wi[..., 0])
        for texel, weight in zip(*weights_linear_in_cosine(wi, height, width), strict=True):
            total = total + weight * at_middle[texel] * probability.gather(1, cells.of_texel[texel])
        return total

    return Technique(normal, place, pdf)


def _around(
    texel: Int[Tensor, "N S"],
    down: Float[Tensor, "N S"],
    across: Float[Tensor, "N S"],
    height: int,
    width: int,
) -> Float[Tensor, "N S 3"]:
    """Directions around texels whose density is the weight of the texel in the interpolation.

    Uniform `down` and `across` in [0, 1) give that density. It falls linearly from the texel to its
    neighbours: in the cosine of the polar angle to the rows above and below, in the azimuth to both sides.
    """
    row, column = texel // width, texel % width
    cosines = polar_cosines(height, texel.device).to(down.dtype)
    middle = cosines[row]
    above, below = cosines[(row - 1).clamp_min(0)], cosines[(row + 1).clamp_max(height - 1)]
    # Share of the weight above the middle: 0 in the first row, 1 in the last.
    share = (above - middle) / (above - below)
    rising = torch.lerp(above, middle, (down / share.clamp_min(1e-12)).clamp_max(1).sqrt())
    falling = torch.lerp(below, middle, ((1 - down) / (1 - share).clamp_min(1e-12)).clamp_max(1).sqrt())
    cos_theta = torch.where(down < share, rising, falling)
    aside = torch.where(across < 0.5, (2 * across).sqrt() - 1, 1 - (2 * (1 - across)).sqrt())
    return direction_at(cos_theta, 2 * math.pi * (column + 0.5 + aside) / width)


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
    directions = map_directions(height, width).to(device).view(-1, 3)
    center = torch.zeros(len(size), 3, device=device).index_add(0, of_texel, directions)
    center = torch.nn.functional.normalize(center, dim=-1)
    to_center = (directions * center[of_texel]).sum(-1).clamp(-1, 1).acos().max().item()
    # A texel contributes to directions up to one row and one column away.
    radius = min(to_center + math.hypot(math.pi / (height - 1), 2 * math.pi / width), math.pi / 2)
    return _Cells(of_texel, order, last - size + 1, last, center, radius)
