"""Environment maps in the layouts of other programs (docs/assets.md).

In this project, row j has the angle πj/(h − 1) from +Z of the world, and column i has the azimuth
φ = 2π(i + ½)/w from +Y towards +X. In other programs, row j has the angle π(j + ½)/h, and the centre of the
image looks along a different axis.
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
"""Azimuth of this project at the left edge of the image, in turns.

Blender and three.js: the centre looks along +X, and +Y is a quarter of the width to its left (Cycles,
`direction_to_equirectangular`). Unreal: its +X, which is +X here, is at three quarters of the width, and its
−Y, which is +Y here, is in the centre (`LookupLongLat` of the texture compressor).
"""
UPSAMPLING, MAX_UPSAMPLED_ROWS = 4, 512
"""Number of rows relative to the original map, and the number above which no rows are added. The finer grid
preserves the bilinear interpolation between the original texels.
"""


def equirectangular(
    radiance: Float[Tensor, "3 H W"], program: Literal["blender", "unreal"]
) -> Float[Tensor, "h w 3"]:
    """Resample an environment map to the layout of a program; linear RGB, width = 2 · height."""
    height = max(radiance.shape[1], min(UPSAMPLING * radiance.shape[1], MAX_UPSAMPLED_ROWS))
    width = 2 * height
    theta = math.pi * (torch.arange(height, dtype=torch.float64)[:, None] + 0.5) / height
    turns = (torch.arange(width, dtype=torch.float64) + 0.5) / width + LEFT_EDGE[program]
    phi = 2 * math.pi * turns
    axes = (phi.sin() * theta.sin(), phi.cos() * theta.sin(), theta.cos().expand(-1, width))
    return interpolate(radiance, torch.stack(axes, dim=-1).to(radiance))
