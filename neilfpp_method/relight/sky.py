"""Distant light for path tracing: a latitude-longitude map that can be evaluated and sampled.

Two layouts of rows and any azimuth of the first column are supported, so that maps need not be resampled.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import cached_property

import torch
from jaxtyping import Float, Int
from torch import Tensor
from torch.nn import functional

from neilfpp_method.fields.direction_map import (
    closed_in_azimuth,
    cos_edges,
    direction_at,
    grid_position,
    row_solid_angles,
    texel_at,
    texel_means,
)
from neilfpp_method.fields.environment import EnvironmentLight
from neilfpp_method.shading.color import luminance

__all__ = ["Sky", "SkySample", "sky_of_run"]


@dataclass(frozen=True)
class SkySample:
    """Unit directions towards the light, and their density per steradian."""

    wi: Float[Tensor, "N 3"]
    pdf: Float[Tensor, " N"]


@dataclass(frozen=True)
class Sky:
    """An environment map around +z with bilinear interpolation; linear RGB, not negative, not black.

    Column i has the azimuth φ = start + 2π(i + ½)/W; directions are (sin φ sin θ, cos φ sin θ, cos θ).

    Attributes:
        radiance: texels; the first row is at +z.
        rows_at_poles: if True, row j has θ = πj/(H − 1), as in this package's files, so the first and last
            row are the poles; if False, it has θ = π(j + ½)/H, as in most programs.
        start: azimuth of the left edge of column 0, radians.

    Example:
        >>> sky = Sky(torch.ones(8, 16, 3), rows_at_poles=True, start=0.0)
        >>> sky.sample(torch.rand(5, 2)).pdf.shape
        torch.Size([5])
    """

    radiance: Float[Tensor, "H W 3"]
    rows_at_poles: bool
    start: float

    def lookup(self, wi: Float[Tensor, "N 3"]) -> Float[Tensor, "N 3"]:
        """Radiance that arrives from unit directions, by bilinear interpolation."""
        height, width = self.radiance.shape[:2]
        grid = grid_position(*self._to_texels(wi), height, width)[None, None]
        values = functional.grid_sample(self._closed, grid, padding_mode="border", align_corners=True)
        return values[0, :, 0].T

    def sample(self, u: Float[Tensor, "N 2"]) -> SkySample:
        """Sample directions from random numbers in [0, 1), in proportion to luminance times solid angle."""
        height, width = self.radiance.shape[:2]
        by_row, by_texel = self._cumulated_rows, self._cumulated
        u = u.double()
        # The row first, then the column within it, which preserves the stratification of u.
        down = _invert(by_row, u[:, 0] * by_row[-1], 0, height)
        row = down.index
        before = torch.where(row > 0, by_texel[(row * width - 1).clamp_min(0)], 0.0)
        mass = by_texel[row * width + width - 1] - before
        across = _invert(by_texel, before + u[:, 1] * mass, row * width, row * width + width)
        cos_theta = torch.lerp(self._cos_edges[row], self._cos_edges[row + 1], down.position)
        phi = self.start + 2 * math.pi * (across.index - row * width + across.position) / width
        wi = direction_at(cos_theta, phi).float()
        return SkySample(wi, self.pdf(wi))

    def pdf(self, wi: Float[Tensor, "N 3"]) -> Float[Tensor, " N"]:
        """Density of `sample` at unit directions, per steradian; constant over a texel."""
        return self._density[texel_at(*self._to_texels(wi), *self.radiance.shape[:2])]

    def _to_texels(self, wi: Float[Tensor, "N 3"]) -> tuple[Float[Tensor, " N"], Float[Tensor, " N"]]:
        """Texel coordinates of directions: column in [−½, W − ½), row in [−½, H − ½]."""
        height, width = self.radiance.shape[:2]
        turns = (torch.atan2(wi[:, 0], wi[:, 1]) - self.start) / (2 * math.pi)
        # acos would be inaccurate near the poles.
        theta = torch.atan2(wi[:, :2].norm(dim=-1), wi[:, 2]) / math.pi
        row = theta * (height - 1) if self.rows_at_poles else theta * height - 0.5
        return (turns - turns.floor()) * width - 0.5, row

    @cached_property
    def _closed(self) -> Float[Tensor, "1 3 H C"]:
        return closed_in_azimuth(self.radiance.permute(2, 0, 1))[None].contiguous()

    @property
    def _cos_edges(self) -> Float[Tensor, " E"]:
        """cos θ of the edges between rows, float64."""
        return cos_edges(len(self.radiance), self.radiance.device, torch.float64, self.rows_at_poles)

    @cached_property
    def _mass(self) -> Float[Tensor, "H W"]:
        """Mean luminance of bilinear radiance over each texel, times its solid angle; float64."""
        return texel_means(luminance(self.radiance.double())) * self._solid_angles[:, None]

    @cached_property
    def _solid_angles(self) -> Float[Tensor, " H"]:
        return row_solid_angles(self._cos_edges, self.radiance.shape[1])

    @cached_property
    def _cumulated(self) -> Float[Tensor, " T"]:
        """Cumulated masses of the texels; float64, because float32 cannot sum eight million texels."""
        return self._mass.reshape(-1).cumsum(0)

    @cached_property
    def _cumulated_rows(self) -> Float[Tensor, " H"]:
        """Cumulated masses of the rows: the values of `_cumulated` at the last texel of each row."""
        width = self.radiance.shape[1]
        return self._cumulated[width - 1 :: width].contiguous()

    @cached_property
    def _density(self) -> Float[Tensor, " T"]:
        return (self._mass / self._mass.sum() / self._solid_angles[:, None]).reshape(-1).float()


def sky_of_run(light: EnvironmentLight) -> Sky:
    """The estimated environment map of a run, without resampling."""
    return Sky(light.log_radiance.detach().exp().permute(1, 2, 0).contiguous(), rows_at_poles=True, start=0.0)


@dataclass(frozen=True)
class _Entry:
    """The entries of a list that contain cumulated values, and the positions in them, from 0 to 1."""

    index: Int[Tensor, " N"]
    position: Float[Tensor, " N"]


def _invert(
    cumulated: Float[Tensor, " K"],
    value: Float[Tensor, " N"],
    first: Int[Tensor, " N"] | int,
    end: Int[Tensor, " N"] | int,
) -> _Entry:
    """Find the entry among first … end − 1 that contains a cumulated value."""
    index = torch.searchsorted(cumulated, value, right=True)
    index = torch.minimum(torch.maximum(index, torch.as_tensor(first)), torch.as_tensor(end) - 1)
    before = torch.where(index > 0, cumulated[(index - 1).clamp_min(0)], 0.0)
    position = (value - before) / (cumulated[index] - before).clamp_min(torch.finfo(torch.float64).tiny)
    return _Entry(index, position.clamp(0, 1))
