"""Latitude-longitude maps over the sphere of directions, with +z as the pole.

Row j is at the angle θ = π j/(h − 1) from +z, column i at the azimuth φ = 2π (i + ½)/w, and the direction
there is (sin φ sin θ, cos φ sin θ, cos θ): the layout of environment maps (docs/conventions.md).
"""

from __future__ import annotations

import functools
import math

import torch
from jaxtyping import Float, Int
from torch import Tensor
from torch.nn import functional

__all__ = [
    "closed_in_azimuth",
    "cos_edges",
    "direction_at",
    "directions_within",
    "grid_position",
    "interpolate",
    "interpolation_solid_angles",
    "interpolation_weights",
    "map_directions",
    "polar_cosines",
    "row_solid_angles",
    "texel_at",
    "texel_centers",
    "texel_means",
    "texel_solid_angles",
    "texels_of",
    "weights_linear_in_cosine",
]

NEIGHBOR_WEIGHT, TEXEL_WEIGHT = 1 / 8, 3 / 4
"""Weights of each of the two neighbours and of the texel itself in the mean, over a texel, of linear
interpolation along one axis.
"""


def interpolate(values: Float[Tensor, "C H W"], wi: Float[Tensor, "M S 3"]) -> Float[Tensor, "M S C"]:
    """Interpolate a map bilinearly at unit directions; it is periodic in azimuth."""
    _, height, width = values.shape
    closed = closed_in_azimuth(values)
    at = grid_position(*_columns_and_rows(wi, height, width), height, width).to(closed.dtype)
    return functional.grid_sample(closed[None], at[None], align_corners=True)[0].permute(1, 2, 0)


def interpolation_weights(
    wi: Float[Tensor, "N S 3"], height: int, width: int
) -> tuple[Int[Tensor, "4 N S"], Float[Tensor, "4 N S"]]:
    """The four texels, row by row, between which `interpolate` interpolates, and their weights."""
    column, row = _columns_and_rows(wi, height, width)
    top = row.floor().clamp(0, max(height - 2, 0))
    return _four_texels(column, top, row - top, height, width)


def weights_linear_in_cosine(
    wi: Float[Tensor, "N S 3"], height: int, width: int
) -> tuple[Int[Tensor, "4 N S"], Float[Tensor, "4 N S"]]:
    """As `interpolation_weights`, but linear in the cosine of the polar angle. The map has at least two rows.

    The weight of a texel has a closed integral over solid angle (`interpolation_solid_angles`).
    """
    column, row = _columns_and_rows(wi, height, width)
    top = row.floor().clamp(0, height - 2)
    cosines = polar_cosines(height, wi.device).to(wi.dtype)
    above, below = cosines[top.long()], cosines[top.long() + 1]
    # A direction on a row may be rounded to the other side of it.
    down = ((above - wi[..., 2]) / (above - below)).clamp(0, 1)
    return _four_texels(column, top, down, height, width)


def _four_texels(
    column: Float[Tensor, "N S"],
    top: Float[Tensor, "N S"],
    down: Float[Tensor, "N S"],
    height: int,
    width: int,
) -> tuple[Int[Tensor, "4 N S"], Float[Tensor, "4 N S"]]:
    """Texels and weights of a bilinear interpolation `down` from the row `top`, at a position in columns."""
    left = column.floor()
    across = column - left
    columns = torch.stack((left.long() % width, (left.long() + 1) % width))
    rows = torch.stack((top.long(), (top.long() + 1).clamp_max(height - 1)))
    texel = rows[:, None] * width + columns[None]
    weight = torch.stack((1 - down, down))[:, None] * torch.stack((1 - across, across))[None]
    return texel.flatten(0, 1), weight.flatten(0, 1)


def interpolation_solid_angles(
    height: int, width: int, device: torch.device | str = "cpu"
) -> Float[Tensor, " T"]:
    """Integrals of the weights of `weights_linear_in_cosine` over all directions, in sr; their sum is 4π."""
    cosines = polar_cosines(height, device)
    above, below = torch.cat((cosines[:1], cosines[:-1])), torch.cat((cosines[1:], cosines[-1:]))
    return ((above - below) / 2 * 2 * math.pi / width)[:, None].expand(-1, width).reshape(-1)


@functools.lru_cache(maxsize=16)
@torch.inference_mode(False)
def polar_cosines(height: int, device: torch.device | str = "cpu") -> Float[Tensor, " H"]:
    """Cosine of the angle from +z of each row of a map, 1 to −1. The result is kept: do not change it."""
    return (torch.arange(height, dtype=torch.float64) * math.pi / (height - 1)).cos().float().to(device)


def texels_of(wi: Float[Tensor, "*B 3"], height: int, width: int) -> Int[Tensor, "*B"]:
    """Row-major index of the texel that contains a unit direction."""
    return texel_at(*_columns_and_rows(wi, height, width), height, width)


def texel_at(
    column: Float[Tensor, "*B"], row: Float[Tensor, "*B"], height: int, width: int
) -> Int[Tensor, "*B"]:
    """Row-major index of the texel nearest to a position in texels; periodic in azimuth."""
    return (row + 0.5).long().clamp(0, height - 1) * width + (column + 0.5).floor().long() % width


def closed_in_azimuth(values: Float[Tensor, "C H W"]) -> Float[Tensor, "C H E"]:
    """The map with one more column on each side, so that bilinear interpolation wraps around in azimuth."""
    return torch.cat((values[..., -1:], values, values[..., :1]), -1)


def grid_position(
    column: Float[Tensor, "*B"], row: Float[Tensor, "*B"], height: int, width: int
) -> Float[Tensor, "*B 2"]:
    """Positions in texels of a map, as `grid_sample` with `align_corners` expects them of the closed map.

    Args:
        column, row: positions, 0 at the middle of the first column and row.
        height, width: size of the map, without the two columns of `closed_in_azimuth`.
    """
    return torch.stack((2 * (column + 1) / (width + 1) - 1, 2 * row / (height - 1) - 1), -1)


def texel_means(values: Float[Tensor, "H W"]) -> Float[Tensor, "H W"]:
    """Mean over each texel of the bilinear interpolation of a map."""
    means = NEIGHBOR_WEIGHT * (values.roll(1, 1) + values.roll(-1, 1)) + TEXEL_WEIGHT * values
    above, below = torch.cat((means[:1], means[:-1])), torch.cat((means[1:], means[-1:]))
    return NEIGHBOR_WEIGHT * (above + below) + TEXEL_WEIGHT * means


def map_directions(height: int, width: int) -> Float[Tensor, "height width 3"]:
    """The unit direction of each texel of a map."""
    theta = math.pi * torch.arange(height, dtype=torch.float64)[:, None] / (height - 1)
    phi = 2 * math.pi * (torch.arange(width, dtype=torch.float64)[None] + 0.5) / width
    axes = (phi.sin() * theta.sin(), phi.cos() * theta.sin(), theta.cos().expand(-1, width))
    return torch.stack(axes, -1).float()


def texel_solid_angles(height: int, width: int, device: torch.device | str = "cpu") -> Float[Tensor, " T"]:
    """Solid angles of the texels, row by row, in sr; their sum is 4π."""
    return row_solid_angles(cos_edges(height, device), width)[:, None].expand(-1, width).reshape(-1)


def row_solid_angles(edges: Float[Tensor, " E"], width: int) -> Float[Tensor, " H"]:
    """Solid angle of a texel of each row, in sr, from the cosines of the edges of the rows."""
    return (edges[:-1] - edges[1:]) * 2 * math.pi / width


def directions_within(
    texel: Int[Tensor, "*B"], down: Float[Tensor, "*B"], across: Float[Tensor, "*B"], height: int, width: int
) -> Float[Tensor, "*B 3"]:
    """Directions in texels, at shares of their height and width.

    Uniform shares are uniform in solid angle.
    """
    row, column = texel // width, texel % width
    edges = cos_edges(height, down.device).to(down.dtype)
    cos_theta = torch.lerp(edges[row], edges[row + 1], down)
    return direction_at(cos_theta, 2 * math.pi * (column + across) / width)


def direction_at(cos_theta: Float[Tensor, "*B"], phi: Float[Tensor, "*B"]) -> Float[Tensor, "*B 3"]:
    """Unit directions at the cosine of the angle from +z and at the azimuth φ, radians."""
    sin_theta = ((1 - cos_theta) * (1 + cos_theta)).clamp_min(0).sqrt()
    return torch.stack((phi.sin() * sin_theta, phi.cos() * sin_theta, cos_theta), -1)


def texel_centers(height: int, width: int, device: torch.device | str = "cpu") -> Float[Tensor, "T 3"]:
    """The direction that halves the solid angle of each texel in height and width, row by row."""
    texel = torch.arange(height * width, device=device)
    half = torch.full((height * width,), 0.5, device=device)
    return directions_within(texel, half, half, height, width)


@functools.lru_cache(maxsize=16)
@torch.inference_mode(False)
def cos_edges(
    height: int,
    device: torch.device | str = "cpu",
    dtype: torch.dtype = torch.float32,
    rows_at_poles: bool = True,
) -> Float[Tensor, " E"]:
    """Cosines of the polar angles that bound the rows of a map.

    The result is kept, because training draws directions within texels in every step. Do not change it. It
    is not an inference tensor, so that later calls can be differentiated.

    Args:
        height: number of rows.
        device: device of the result.
        dtype: type of the result.
        rows_at_poles: if True, the first and last row are at the poles, and an edge is halfway between two
            rows; if False, all rows have the same height, and the edges of the outer rows are at the poles.
    """
    edge = torch.arange(height + 1, dtype=dtype, device=device)
    if rows_at_poles:
        return ((edge - 0.5).clamp(0, height - 1) * math.pi / (height - 1)).cos()
    return (edge * math.pi / height).cos()


def _columns_and_rows(
    wi: Float[Tensor, "*B 3"], height: int, width: int
) -> tuple[Float[Tensor, "*B"], Float[Tensor, "*B"]]:
    """Continuous position of a direction in a map, in texels: column in [−½, w − ½), row in [0, h − 1]."""
    x, y, z = wi.unbind(-1)
    turn = torch.atan2(x, y) / (2 * math.pi)
    return (turn - turn.floor()) * width - 0.5, torch.acos(z.clamp(-1, 1)) / math.pi * (height - 1)
