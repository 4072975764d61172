"""The objective of a light fit: errors of remembered points, and priors on light and base colour.

The priors are of ratios, so that none prefers a dimmer light and brighter surfaces: the total variation of
the map's log radiance, differences of log base colour, lamps by their share of all light, and the tint. A
price per amount of light would dim the light at every fit, as the base colour follows.
"""

from __future__ import annotations

from dataclasses import dataclass

import torch
from jaxtyping import Float, Int
from torch import Tensor
from torch.nn import functional

from neilfpp_method.lighting.sky import KnownSky
from neilfpp_method.lighting.transport import Transport
from neilfpp_method.settings.types import LightFitConfig
from neilfpp_method.shading.color import residual, response_slope
from neilfpp_method.structures import Indexable, Material

__all__ = [
    "FLOOR",
    "Objective",
    "Target",
    "error_unit",
    "nearest_points",
    "tint",
    "total_variation",
    "unevenness",
]

FLOOR = 0.1
"""Errors are relative to the pixel plus this share of a typical one: dark pixels are mostly noise."""
OUTLIER = 0.1
"""Relative errors beyond this count linearly, not squared: no light explains some of the points."""
SKY = 1.0
"""Weight of the difference between the map's log radiance and what cameras saw beyond the scene, per texel,
against the relative error: that much is certain, and the scale of light and base colour hangs on it.
"""
SPARSITY = 0.001
"""Weight of the lamps, by the logarithm of their shares of all light, against the relative error."""
QUADRATIC_BELOW = 1e-2
"""Differences of logarithms below this count by their square, so that the gradient has no jump at 0."""
LINEAR_SHARE = 0.02
"""Share of all light below which a lamp's price is linear; above it, logarithmic."""
NEIGHBOURS = 4
"""Points whose base colour a point is compared with."""
DARK_FLOOR = 0.02
"""Base colours are raised to this before their logarithms are compared."""


@dataclass(frozen=True)
class Target(Indexable):
    """What points look like: their material, constants, and their pixels in the response of the capture."""

    position: Float[Tensor, "N 3"]
    material: Material
    pixel: Float[Tensor, "N 3"]

    def __getitem__(self, rows: Tensor | slice) -> Target:
        return Target(self.position[rows], self.material[rows], self.pixel[rows])


@dataclass(frozen=True)
class Objective:
    """What a light is to minimise.

    Attributes:
        response: of the capture, "linear" or "srgb".
        unit: what a pixel of typical brightness changes by per unit of log radiance (`response_slope`):
            itself, where the response is linear. Errors are relative to that of the pixel and a share of
            this.
        config: the weights.
        sky: what cameras saw of the light itself; none where they saw nothing of it.
        monochrome: the map has one channel for all three colours.
    """

    response: str
    unit: float
    config: LightFitConfig
    sky: KnownSky | None = None
    monochrome: bool = False

    def relative_error(
        self,
        strength: Float[Tensor, "T 3"],
        carried: Transport,
        target: Target,
        gain: Float[Tensor, "#N 3"] | float,
    ) -> Float[Tensor, "N 3"]:
        """How far radiance is off, of itself: what the camera stores of the points, their base colour times
        `gain`, against their pixels; a clipped one is a lower bound.
        """
        material = target.material
        tinted = Material((material.base_color * gain).clamp(0, 1), material.roughness, material.metallic)
        off = residual(carried.outgoing(tinted, strength), target.pixel, self.response)
        return off / error_unit(target.pixel, self.response, self.unit)

    def misfit(
        self, strength: Float[Tensor, "T 3"], carried: Transport, target: Target, gain: Float[Tensor, "#N 3"]
    ) -> Float[Tensor, ""]:
        """The relative error in the mean: by its square where it is small, by its size where it is large."""
        error = self.relative_error(strength, carried, target, gain)
        return functional.smooth_l1_loss(error, torch.zeros_like(error), beta=OUTLIER)

    def unlikely(self, log_radiance: Float[Tensor, "3 H W"]) -> Float[Tensor, ""]:
        """Priors on a map alone: smoothness, and agreement with what cameras saw of it."""
        uneven = self.config.smoothness * total_variation(log_radiance)
        if self.sky is None or not log_radiance.numel():
            return uneven
        return uneven + SKY * self.sky.misfit(log_radiance)

    def price(self, brought: Float[Tensor, " M"], all_light: Float[Tensor, " 3"]) -> Float[Tensor, ""]:
        """Priors on lamps, by the light that each brings to the points, and on the tint of all light.

        Σ ln(1 + share/s) over lamps is concave: one strong lamp is cheaper than two half as strong.
        """
        share = brought / all_light.mean()
        lamps = SPARSITY * (share / LINEAR_SHARE).log1p().sum()
        return lamps + self.config.whiteness * tint(all_light)


def error_unit(pixel: Float[Tensor, "*B 3"], response: str, typical: float) -> Float[Tensor, "*B 3"]:
    """What a pixel may change by for a relative error of 1.

    Args:
        pixel: in the capture's response.
        response: "linear" or "srgb".
        typical: what a pixel of typical brightness changes by per unit of log radiance (`response_slope`).
    """
    return response_slope(pixel, response) + FLOOR * typical


def total_variation(values: Float[Tensor, "C H W"]) -> Float[Tensor, ""]:
    """Σ |difference of neighbours| per texel, of a map that is closed in azimuth."""
    across = torch.cat((values, values[..., :1]), -1).diff(dim=-1)
    down = values.diff(dim=1)
    size = max(1, values[0].numel())
    return sum(_size(step).sum() for step in (across, down)) / size


def nearest_points(position: Float[Tensor, "N 3"]) -> Int[Tensor, "N K"]:
    """The nearest other points of each; K is `NEIGHBOURS`, less where there are fewer."""
    apart = torch.cdist(position, position).fill_diagonal_(torch.inf)
    return apart.topk(min(NEIGHBOURS, len(position) - 1), largest=False).indices


def unevenness(base_color: Float[Tensor, "N 3"], nearest: Int[Tensor, "N K"]) -> Float[Tensor, ""]:
    """Mean |difference of log base colour| between neighbours: sharp and gradual edges cost the same."""
    logarithm = base_color.clamp_min(DARK_FLOOR).log()
    apart = logarithm[:, None] - logarithm[nearest]
    return _size(apart).sum() / max(1, apart.numel())


def _size(difference: Float[Tensor, ...]) -> Float[Tensor, ...]:
    return (difference.square() + QUADRATIC_BELOW**2).sqrt()


def tint(light: Float[Tensor, " 3"]) -> Float[Tensor, ""]:
    """How far light is from white: the variance of its logarithm over the channels."""
    return light.clamp_min(1e-20).log().var(correction=0)
