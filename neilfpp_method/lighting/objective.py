"""What speaks against a light: points that look otherwise than their pixels, and what is known of light in general.

What is known in general takes no side in the factor between light and base colour: the total variation of the map is of
logarithms, lamps pay for their share of all light, and the tint is of ratios. A price per amount of light would make the light
dimmer and surfaces brighter at every fit, as the base colour follows.
"""

from __future__ import annotations

from dataclasses import dataclass

import torch
from jaxtyping import Float
from torch import Tensor
from torch.nn import functional

from neilfpp_method.config import LightFitConfig
from neilfpp_method.lighting.transport import Transport
from neilfpp_method.shading.color import apply_response
from neilfpp_method.structures import Indexable, Material

__all__ = ["Target", "misfit", "price", "relative_error", "tint", "total_variation"]

SMOOTHED = 1e-2
"""Differences of log radiance below this count by their square, so that the total variation has a gradient everywhere."""
SMALL_SHARE = 0.02
"""Of all light: a lamp that brings less pays for what it brings, one that brings much more hardly for more than being there."""


@dataclass(frozen=True)
class Target(Indexable):
    """What points look like: their material, constants, and their pixels in the response of the capture."""

    material: Material
    pixel: Float[Tensor, "N 3"]

    def __getitem__(self, rows: Tensor | slice) -> Target:
        return Target(self.material[rows], self.pixel[rows])


def relative_error(
    strength: Float[Tensor, "T 3"],
    carried: Transport,
    target: Target,
    gain: Float[Tensor, " 3"] | float,
    response: str,
    unit: float,
    config: LightFitConfig,
) -> Float[Tensor, "N 3"]:
    """What the camera stores of the points, their base colour times `gain`, against their pixels."""
    material = target.material
    tinted = Material((material.base_color * gain).clamp(0, 1), material.roughness, material.metallic)
    shown = apply_response(carried.outgoing(tinted, strength), response)
    return (shown - target.pixel) / (target.pixel + config.floor * unit)


def misfit(
    strength: Float[Tensor, "T 3"],
    carried: Transport,
    target: Target,
    gain: Float[Tensor, " 3"],
    response: str,
    unit: float,
    config: LightFitConfig,
) -> Float[Tensor, ""]:
    """The relative error in the mean: by its square where it is small, by its size where it is large."""
    error = relative_error(strength, carried, target, gain, response, unit, config)
    return functional.smooth_l1_loss(error, torch.zeros_like(error), beta=config.outlier)


def price(brought: Float[Tensor, " M"], all_light: Float[Tensor, " 3"], config: LightFitConfig) -> Float[Tensor, ""]:
    """Of lamps, by the light that each brings to the points, and of the tint of all light that reaches them.

    Σ ln(1 + share/s) over the lamps' shares of all light is concave: one strong lamp is cheaper than two half as strong.
    """
    share = brought / all_light.mean()
    return config.sparsity * (share / SMALL_SHARE).log1p().sum() + config.whiteness * tint(all_light)


def total_variation(values: Float[Tensor, "C H W"]) -> Float[Tensor, ""]:
    """Σ |difference of neighbours| per texel, of a map that is closed in azimuth."""
    across = torch.cat((values, values[..., :1]), -1).diff(dim=-1)
    down = values.diff(dim=1)
    size = max(1, values[0].numel())
    return sum((step.square() + SMOOTHED**2).sqrt().sum() for step in (across, down)) / size


def tint(light: Float[Tensor, " 3"]) -> Float[Tensor, ""]:
    """How far light is from white: the variance of its logarithm over the channels."""
    return light.clamp_min(1e-20).log().var(correction=0)
