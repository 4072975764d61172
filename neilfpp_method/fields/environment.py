"""L for distant light: an environment map, the same at every point, with importance sampling.

`direction_map` defines the layout of the map.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import torch
from jaxtyping import Float
from torch import Tensor, nn

from neilfpp_method.fields.direction_map import (
    directions_within,
    interpolate,
    map_directions,
    texel_solid_angles,
)
from neilfpp_method.fields.map_sampling import radiance_times_cosine
from neilfpp_method.shading.color import luminance
from neilfpp_method.shading.sampling import Technique

__all__ = ["EVEN_ROWS", "EnvironmentLight", "TexelDirections"]

UNIFORM_SHARE = 0.1
"""Share of the samples that ignore the radiance, so that the density is positive above every horizon."""
EVEN_ROWS = 16
"""Rows of the map of an even light, whose texels are all equal."""
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
        self.even = False
        # The size of a given map is not in the settings: take it from the checkpoint.
        self.register_load_state_dict_pre_hook(_take_size)

    @torch.no_grad()
    def set_even(self, even: bool) -> None:
        """Make the light even, with the mean radiance of the map over solid angle, or a map again."""
        self.even = even
        if even:
            self.average()

    @torch.no_grad()
    def average(self) -> None:
        """Set all texels to the mean radiance of the map over solid angle."""
        if (self.log_radiance != self.log_radiance[:, :1, :1]).any():
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
        """Sampling of directions in proportion to the radiance times the cosine about a normal.

        None for an even light.
        """
        return None if self.even else radiance_times_cosine(self._sampled_luminance(), normal)

    @torch.no_grad()
    def texel_directions(self, like: Float[Tensor, "N 3"]) -> TexelDirections:
        """Sample a random direction in every texel, for each row of `like`: T strata of the sphere."""
        _, height, width = self.log_radiance.shape
        texel = torch.arange(height * width, device=like.device).expand(len(like), -1)
        within = torch.rand(2, *texel.shape, device=like.device, dtype=like.dtype)
        wi = directions_within(texel, within[0], within[1], height, width)
        return TexelDirections(wi, self._texel_solid_angles())

    def _resize(self, height: int, width: int) -> None:
        """Replace the map by one of this size, with undefined content."""
        self.log_radiance = self.log_radiance.new_zeros(3, height, width)

    def _texel_solid_angles(self) -> Float[Tensor, " T"]:
        _, height, width = self.log_radiance.shape
        return texel_solid_angles(height, width, self.log_radiance.device).to(self.log_radiance.dtype)

    @torch.no_grad()
    def _sampled_luminance(self) -> Float[Tensor, "H W"]:
        """Luminance of the texels relative to the mean, mixed with a constant."""
        brightness = luminance(self.log_radiance.permute(1, 2, 0).exp())
        mean = (brightness.flatten() @ self._texel_solid_angles()) / (4 * math.pi)
        return (1 - UNIFORM_SHARE) * brightness / mean + UNIFORM_SHARE


def _take_size(light: EnvironmentLight, state: Mapping[str, Any], prefix: str, *_: object) -> None:
    """Resize the map to that of a checkpoint, before its values are loaded."""
    saved = state.get(f"{prefix}log_radiance")
    if isinstance(saved, Tensor) and saved.ndim == 3 and min(saved.shape[1:]) >= 2:
        light._resize(*saved.shape[1:])
