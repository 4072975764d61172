"""What cameras saw of the light itself: pixels that show what lies beyond the scene.

A map has one radiance for a direction, from wherever one looks. What lies near is seen from every camera in
another direction; its texels disagree with themselves, and count for less.
"""

from __future__ import annotations

from dataclasses import dataclass

import torch
from jaxtyping import Float
from torch import Tensor, nn
from torch.nn import functional

from neilfpp_method.fields.direction_map import texels_of
from neilfpp_method.shading.color import luminance, srgb_to_linear

__all__ = ["KnownSky", "SkySightings"]

HALF_WEIGHT_SPREAD = 0.3
"""Standard deviation of the radiance within a texel, over its mean, at which the texel counts for half."""
QUADRATIC_BELOW = 0.1
"""Differences of logarithms below this count by their square."""
DARK_FLOOR = 1e-3
"""Share of the mean radiance below which a texel counts as this dark where logarithms are compared."""


@dataclass(frozen=True)
class KnownSky:
    """Log radiance of map texels as cameras saw them, and its weight: 0 where none looked, at most 1."""

    log_radiance: Float[Tensor, "3 H W"]
    weight: Float[Tensor, "H W"]

    def misfit(self, log_radiance: Float[Tensor, "3 H W"]) -> Float[Tensor, ""]:
        """How far a map is from what was seen, in the mean over its texels."""
        off = functional.smooth_l1_loss(
            log_radiance, self.log_radiance, beta=QUADRATIC_BELOW, reduction="none"
        )
        return (self.weight * off.mean(0)).mean()


class SkySightings(nn.Module):
    """Sums over the pixels that fell into each texel of a map. They are part of a checkpoint.

    Args:
        height: rows of the map; it has twice as many columns.
        response: of the capture, "linear" or "srgb". A pixel of an LDR image that is clipped says too little:
            its texel counts as unseen.
    """

    def __init__(self, height: int, response: str) -> None:
        super().__init__()
        self.response = response
        self.register_buffer("radiance", torch.zeros(3, height, 2 * height))
        self.register_buffer("squares", torch.zeros(height, 2 * height))  # of luminance
        self.register_buffer("pixels", torch.zeros(height, 2 * height))
        self.register_buffer("clipped", torch.zeros(height, 2 * height))

    @torch.no_grad()
    def remember(self, directions: Float[Tensor, "N 3"], color: Float[Tensor, "N 3"]) -> None:
        """Add pixels, as images hold them, whose rays pass the scene by."""
        clipped = torch.zeros_like(color[:, 0])
        if self.response == "srgb":
            clipped, color = (color >= 1).any(-1).to(color.dtype), srgb_to_linear(color)
        texel = texels_of(directions, *self.pixels.shape)
        self.radiance.view(3, -1).index_add_(1, texel, color.t())
        self.squares.view(-1).index_add_(0, texel, luminance(color).square())
        self.pixels.view(-1).index_add_(0, texel, torch.ones_like(clipped))
        self.clipped.view(-1).index_add_(0, texel, clipped)

    def known(self) -> KnownSky:
        """What the texels are, as far as they were seen."""
        count = self.pixels.clamp_min(1)
        mean = self.radiance / count
        bright = luminance(mean.permute(1, 2, 0))
        spread = (self.squares / count - bright.square()).clamp_min(0) / bright.square().clamp_min(1e-20)
        weight = self.pixels / (self.pixels + 1) / (1 + spread / HALF_WEIGHT_SPREAD**2) * (self.clipped == 0)
        floor = DARK_FLOOR * self.radiance.sum() / (3 * self.pixels.sum().clamp_min(1))
        return KnownSky(mean.clamp_min(floor.clamp_min(1e-20)).log(), weight)
