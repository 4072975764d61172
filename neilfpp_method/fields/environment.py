"""L for distant light: an environment map, the same at every point, with importance sampling.

`direction_map` defines the layout of the map.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import torch
from jaxtyping import Float, Int
from torch import Tensor, nn

from neilfpp_method.fields.direction_map import interpolate, map_directions, texels_of
from neilfpp_method.shading.color import luminance
from neilfpp_method.shading.sampling import Technique
from neilfpp_method.structures import IncidentSamples

__all__ = ["EVEN_ROWS", "EnvironmentLight", "TexelDirections"]

UNIFORM_SHARE = 0.1
"""Share of the samples that are uniform over the sphere, so that the density is positive everywhere."""
MEAN_OF_CELL = (1 / 8, 3 / 4)
"""Weights of each neighbor and of the cell itself in the mean, over a cell, of the linear interpolation
between cell centers.
"""
EVEN_ROWS = 16
"""Rows of the map of an even light. Its texels are all equal; they are the directions that a fit samples."""
MIN_RADIANCE = 1e-6
"""Lower bound on the radiance of a given map, relative to its mean, because logarithms are stored."""


@dataclass(frozen=True)
class TexelDirections:
    """One direction in each of T texels, for each of N points, and the solid angles of the texels (sr)."""

    wi: Float[Tensor, "N T 3"]
    solid_angle: Float[Tensor, " T"]


class EnvironmentLight(nn.Module):
    """An environment map: a grid of log radiance whose radiance is interpolated bilinearly.

    The map is a buffer, not a parameter: outgoing radiance is linear in its radiance, so `lighting` solves
    for it.

    An even light (`even`) has the same radiance from all directions: all texels are equal, and importance
    sampling has no use.

    Args:
        height: rows of the map; it has twice as many columns.
        initial_radiance: initial radiance of all texels.
    """

    def __init__(self, height: int, initial_radiance: float) -> None:
        super().__init__()
        self.register_buffer("log_radiance", torch.full((3, height, 2 * height), math.log(initial_radiance)))
        self.register_buffer("cos_edges", _cos_edges(height), persistent=False)
        self.even = False
        # The size of a given map is not in the settings: take it from the checkpoint.
        self.register_load_state_dict_pre_hook(_take_size)

    @torch.no_grad()
    def be_even(self, even: bool) -> None:
        """Make the light even, with the mean radiance of the map over solid angle, or a map again."""
        self.even = even
        if even and (self.log_radiance != self.log_radiance[:, :1, :1]).any():
            share = self._texel_solid_angles() / (4 * math.pi)
            self.log_radiance.copy_((self.log_radiance.exp().flatten(1) @ share).log()[:, None, None])

    @torch.no_grad()
    def show(self, radiance: Float[Tensor, "3 H W"]) -> None:
        """Replace the map by linear radiance of any size with at least 2 rows, not all black.

        The device does not change.
        """
        self._resize(*radiance.shape[1:])
        self.log_radiance.copy_(radiance.clamp_min(MIN_RADIANCE * radiance.mean()).log())

    @torch.no_grad()
    def resample(self, log_radiance: Float[Tensor, "3 H W"]) -> None:
        """Set the map to that of another size, interpolated in log radiance; its own size does not change."""
        directions = map_directions(*self.log_radiance.shape[1:]).to(self.log_radiance)
        self.log_radiance.copy_(interpolate(log_radiance, directions).permute(2, 0, 1))

    @torch.no_grad()
    def at_most(self, height: int) -> EnvironmentLight:
        """Return this light, or a copy reduced to `height` rows by area means if its map has more."""
        _, rows, columns = self.log_radiance.shape
        if rows <= height:
            return self
        coarse = EnvironmentLight(height, 1.0).to(self.log_radiance.device)
        width = min(2 * height, columns)
        coarse._resize(height, width)
        weight = self._texel_solid_angles()
        row = (torch.arange(rows, device=weight.device) * (height - 1) / (rows - 1) + 0.5).long()
        column = ((torch.arange(columns, device=weight.device) + 0.5) * width / columns).long()
        cell = (row[:, None] * width + column).reshape(-1)
        sums = weight.new_zeros(3, height * width).index_add(
            1, cell, self.log_radiance.exp().flatten(1) * weight
        )
        total = weight.new_zeros(height * width).index_add(0, cell, weight)
        coarse.show((sums / total).view_as(coarse.log_radiance))
        return coarse

    def radiance(self, x: Float[Tensor, "N 3"], wi: Float[Tensor, "#N S 3"]) -> Float[Tensor, "#N S 3"]:
        """Radiance > 0 from directions wi. It does not depend on x, and ignores occlusion."""
        if self.even:
            return self.log_radiance[:, 0, 0].exp().expand(*wi.shape[:-1], 3)
        return interpolate(self.log_radiance.exp(), wi)

    def technique(self, normal: Float[Tensor, "N 3"]) -> Technique | None:
        """Sampling of directions in proportion to the radiance; some lie below the horizon of a normal.

        None for an even light.
        """
        if self.even:
            return None
        return Technique(lambda count, stochastic: self.sample(normal, count, stochastic).wi, self.pdf)

    @torch.no_grad()
    def sample(self, like: Float[Tensor, "N 3"], count: int, stochastic: bool) -> IncidentSamples:
        """Sample `count` directions of the sphere per row of `like`, in proportion to the radiance."""
        shape = (len(like), count)
        strata = torch.arange(count, device=like.device, dtype=like.dtype)
        within = (
            torch.rand(3, *shape, device=like.device, dtype=like.dtype)
            if stochastic
            else like.new_full((3, *shape), 0.5)
        )
        cell = torch.searchsorted(self._texel_shares().cumsum(0), (strata + within[0]) / count)
        wi = self._within(cell, within[1], within[2])
        return IncidentSamples(wi, self.pdf(wi))

    @torch.no_grad()
    def texel_directions(self, like: Float[Tensor, "N 3"]) -> TexelDirections:
        """Sample a random direction in every texel, for each row of `like`: T strata of the sphere."""
        _, height, width = self.log_radiance.shape
        cell = torch.arange(height * width, device=like.device).expand(len(like), -1)
        within = torch.rand(2, *cell.shape, device=like.device, dtype=like.dtype)
        return TexelDirections(self._within(cell, within[0], within[1]), self._texel_solid_angles())

    @torch.no_grad()
    def pdf(self, wi: Float[Tensor, "N S 3"]) -> Float[Tensor, "N S"]:
        """Density of `sample` per steradian over the sphere; constant within a texel."""
        return (self._texel_shares() / self._texel_solid_angles())[
            texels_of(wi, *self.log_radiance.shape[1:])
        ]

    def _resize(self, height: int, width: int) -> None:
        """Replace the map by one of this size, with undefined content."""
        self.log_radiance = self.log_radiance.new_zeros(3, height, width)
        self.cos_edges = _cos_edges(height).to(self.log_radiance)

    def _within(
        self, cell: Int[Tensor, "N S"], down: Float[Tensor, "N S"], across: Float[Tensor, "N S"]
    ) -> Float[Tensor, "N S 3"]:
        """Directions in texels, at shares of their height and width; uniform shares are uniform in area."""
        _, height, width = self.log_radiance.shape
        cell = cell.clamp_max(height * width - 1)
        row, column = cell // width, cell % width
        cos_theta = torch.lerp(self.cos_edges[row], self.cos_edges[row + 1], down)
        phi = 2 * math.pi * (column + across) / width
        sin_theta = ((1 - cos_theta) * (1 + cos_theta)).clamp_min(0).sqrt()
        return torch.stack((phi.sin() * sin_theta, phi.cos() * sin_theta, cos_theta), -1)

    def _texel_solid_angles(self) -> Float[Tensor, " T"]:
        width = self.log_radiance.shape[2]
        rows = (self.cos_edges[:-1] - self.cos_edges[1:]) * 2 * math.pi / width
        return rows[:, None].expand(-1, width).reshape(-1)

    def _texel_shares(self) -> Float[Tensor, " T"]:
        """Probability of each texel: the mean of the interpolated radiance over it times its solid angle.

        The interpolation also brightens the neighbors of a bright texel, so their probability is higher.
        """
        solid_angles = self._texel_solid_angles()
        mean = luminance(self.log_radiance.detach().permute(1, 2, 0).exp())
        mean = MEAN_OF_CELL[0] * (mean.roll(1, 1) + mean.roll(-1, 1)) + MEAN_OF_CELL[1] * mean
        above, below = torch.cat((mean[:1], mean[:-1])), torch.cat((mean[1:], mean[-1:]))
        mean = MEAN_OF_CELL[0] * (above + below) + MEAN_OF_CELL[1] * mean
        power = mean.reshape(-1) * solid_angles
        return (1 - UNIFORM_SHARE) * power / power.sum() + UNIFORM_SHARE * solid_angles / (4 * math.pi)


def _cos_edges(height: int) -> Float[Tensor, " E"]:
    """Cosines of the polar angles that bound the rows: halfway between neighboring rows."""
    return ((torch.arange(height + 1) - 0.5).clamp(0, height - 1) * math.pi / (height - 1)).cos()


def _take_size(light: EnvironmentLight, state: Mapping[str, Any], prefix: str, *_: object) -> None:
    """Resize the map to that of a checkpoint, before its values are loaded."""
    saved = state.get(f"{prefix}log_radiance")
    if isinstance(saved, Tensor) and saved.ndim == 3 and min(saved.shape[1:]) >= 2:
        light._resize(*saved.shape[1:])
