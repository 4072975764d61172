"""Environment maps as other programs lay them out (docs/assets.md).

Ours: row j is at the angle πj/(h − 1) from +Z of the world, column i at the azimuth φ = 2π(i + ½)/w from +Y
towards +X. Theirs have their rows at π(j + ½)/h, and the middle of the picture looks along another axis.
"""

from __future__ import annotations

import math
from typing import Literal

import torch
from jaxtyping import Float
from torch import Tensor

from neilfpp_method.fields.direction_map import interpolate

__all__ = ["equirectangular"]

LEFT_EDGE: dict[str, float] = {"blender": -0.25, "unreal": 0.5}
"""Our azimuth at the left edge of the picture, in turns. Blender and three.js: the middle looks along +X, +Y
is a quarter to its left (Cycles, `direction_to_equirectangular`). Unreal: its +X, which is ours, is three
quarters from the left, and its −Y, our +Y, in the middle (`LookupLongLat` of the texture compressor)."""
FINER, ENOUGH = 4, 512
"""Four times our rows, at most this many unless ours are more: bilinear values between texels stay so."""


def equirectangular(
    radiance: Float[Tensor, "3 H W"], program: Literal["blender", "unreal"]
) -> Float[Tensor, "h w 3"]:
    """A map of ours, resampled, linear RGB as before; twice as many columns as rows."""
    height = max(radiance.shape[1], min(FINER * radiance.shape[1], ENOUGH))
    theta = math.pi * (torch.arange(height, dtype=torch.float64)[:, None] + 0.5) / height
    phi = (
        2
        * math.pi
        * ((torch.arange(2 * height, dtype=torch.float64) + 0.5) / (2 * height) + LEFT_EDGE[program])
    )
    axes = (phi.sin() * theta.sin(), phi.cos() * theta.sin(), theta.cos().expand(-1, 2 * height))
    return interpolate(radiance, torch.stack(axes, dim=-1).to(radiance))
