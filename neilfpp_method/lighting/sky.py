"""Direct observations of the environment map: pixels of rays that pass the scene and show what lies behind.

The radiance of an environment map depends on the direction only. Things that are near appear in different
directions from different cameras, so the pixels that fall into their texels disagree; such texels get a low
weight.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import torch
from jaxtyping import Float
from torch import Tensor, nn
from torch.nn import functional

from neilfpp_method.fields.direction_map import texels_of
from neilfpp_method.shading.color import CLIPPED, luminance, srgb_to_linear

__all__ = ["KnownSky", "SkySightings"]

HALF_WEIGHT_SPREAD = 0.3
"""Relative standard deviation of the luminance within a texel at which its weight is halved."""
QUADRATIC_BELOW = 0.1
"""Difference of log radiance at which the loss changes from quadratic to linear."""
MIN_SEEN_SHARE = 0.2
"""Share of all directions that cameras must have seen so that they fix the scale of the light. In photographs
of a toy, a castle and a tree trunk it was 0.5 to 5 %. With a free scale, the unseen light then got dimmer and
the base colours brighter with every fit.
"""
DARK_FLOOR = 1e-3
"""Texels are raised to at least this share of the mean radiance before the logarithm is taken."""


@dataclass(frozen=True)
class KnownSky:
    """The map as cameras saw it directly.

    Attributes:
        log_radiance: logarithm of the observed radiance of each texel.
        weight: confidence in each texel, from 0 (never seen) to 1.
    """

    log_radiance: Float[Tensor, "3 H W"]
    weight: Float[Tensor, "H W"]

    @property
    def fixes_scale(self) -> bool:
        """Whether cameras saw enough of the light to fix its scale relative to base colour."""
        rows = len(self.weight)
        # A row of the map covers a solid angle in proportion to the sine of its polar angle.
        solid_angle = torch.sin(math.pi * (torch.arange(rows) + 0.5) / rows).to(self.weight)
        return bool(self.weight.mean(1) @ solid_angle > MIN_SEEN_SHARE * solid_angle.sum())

    def misfit(self, log_radiance: Float[Tensor, "3 H W"]) -> Float[Tensor, ""]:
        """Weighted Huber loss between a map and the observation, averaged over the texels."""
        error = functional.smooth_l1_loss(
            log_radiance, self.log_radiance, beta=QUADRATIC_BELOW, reduction="none"
        )
        return (self.weight * error.mean(0)).mean()


class SkySightings(nn.Module):
    """Sums over the pixels that fell into each texel of a map. They are part of a checkpoint.

    Args:
        height: number of rows of the map; it has twice as many columns.
        response: response of the capture, "linear" or "srgb". A texel into which a clipped pixel of an LDR
            image fell counts as not seen, because its radiance is only bounded from below.
    """

    def __init__(self, height: int, response: str) -> None:
        super().__init__()
        self.response = response
        self.register_buffer("radiance", torch.zeros(3, height, 2 * height))
        # Sums of the squared luminance.
        self.register_buffer("squares", torch.zeros(height, 2 * height))
        self.register_buffer("pixels", torch.zeros(height, 2 * height))
        self.register_buffer("clipped", torch.zeros(height, 2 * height))

    @torch.no_grad()
    def remember(self, directions: Float[Tensor, "N 3"], color: Float[Tensor, "N 3"]) -> None:
        """Add the pixels of rays that pass the scene; `color` is in the response of the capture."""
        clipped = torch.zeros_like(color[:, 0])
        if self.response == "srgb":
            clipped, color = (color >= CLIPPED).any(-1).to(color.dtype), srgb_to_linear(color)
        texel = texels_of(directions, *self.pixels.shape)
        self.radiance.view(3, -1).index_add_(1, texel, color.t())
        self.squares.view(-1).index_add_(0, texel, luminance(color).square())
        self.pixels.view(-1).index_add_(0, texel, torch.ones_like(clipped))
        self.clipped.view(-1).index_add_(0, texel, clipped)

    def known(self) -> KnownSky:
        """The observed map and its weights."""
        count = self.pixels.clamp_min(1)
        mean = self.radiance / count
        bright = luminance(mean.permute(1, 2, 0))
        spread = (self.squares / count - bright.square()).clamp_min(0) / bright.square().clamp_min(1e-20)
        weight = self.pixels / (self.pixels + 1) / (1 + spread / HALF_WEIGHT_SPREAD**2) * (self.clipped == 0)
        floor = DARK_FLOOR * self.radiance.sum() / (3 * self.pixels.sum().clamp_min(1))
        return KnownSky(mean.clamp_min(floor.clamp_min(1e-20)).log(), weight)
