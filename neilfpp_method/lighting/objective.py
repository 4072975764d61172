"""The objective of a light fit: the error of remembered points, and priors on light and base colour.

Every prior depends only on ratios, so that none of them prefers a dimmer light with brighter surfaces: the
total variation of the map's log radiance, differences of log base colour, the share of each lamp in all
light, and the tint. A penalty on the absolute amount of light would dim the light a little at every fit,
because the base colour then follows.
"""

from __future__ import annotations

from dataclasses import dataclass

import torch
from jaxtyping import Float, Int
from torch import Tensor
from torch.nn import functional

from neilfpp_method.lighting.sky import KnownSky
from neilfpp_method.lighting.transport import Transport
from neilfpp_method.shading.color import residual, response_slope
from neilfpp_method.structures import Indexable, Material

__all__ = [
    "DARK_FLOOR",
    "ERROR_FLOOR",
    "EVENNESS",
    "STEPS",
    "Objective",
    "Target",
    "error_unit",
    "nearest_points",
    "tint",
    "total_variation",
    "unevenness",
    "white_balance",
]

ERROR_FLOOR = 0.1
"""This share of a typical pixel is added to the denominator of a relative error, because dark pixels are
mostly noise.
"""
OUTLIER_ERROR = 0.1
"""Relative error at which the loss changes from quadratic to linear. There are points that no light explains,
for example if the geometry is wrong there.
"""
SMOOTHNESS = 0.02
"""Weight of the total variation of the map's log radiance per texel, relative to the data term."""
EVENNESS = 0.3
"""Weight of the mean difference of log base colour between neighbouring points, relative to the data term."""
SKY_WEIGHT = 1.0
"""Weight, relative to the data term, of the deviation of the map's log radiance from what cameras saw of it
directly. The weight is high because this observation is reliable and fixes the common scale of light and
base colour.
"""
SPARSITY = 0.001
"""Weight of the sparsity prior on lamps, relative to the data term."""
QUADRATIC_BELOW = 1e-2
"""Scale below which absolute differences of logarithms become quadratic, so that the gradient is continuous
at 0.
"""
WHITENESS = 0.05
"""Weight of the tint of all light that reaches the points, relative to the relative error: images hardly
determine how the tint is shared between light and surfaces.
"""
BALANCE = 0.1
"""Weight of the mean tint of the map's texels in photographs with display values, relative to the data term:
cameras balance white.
"""
PALE_SHARE = 0.01
"""White light, as a share of the brightness of a texel, that is added to its colour before the logarithm."""
LINEAR_SHARE = 0.02
"""Share of all light below which the sparsity prior of a lamp is about linear; above, it is logarithmic."""
NEIGHBORS = 4
"""Number of neighbouring points with which the base colour of a point is compared."""
STEPS = 100
"""Optimisation steps of a fit. Each fit starts from the result of the last one, so few are enough."""
DARK_FLOOR = 0.02
"""Base colours are raised to at least this value before their logarithms are compared."""


@dataclass(frozen=True)
class Target(Indexable):
    """N surface points and what cameras recorded of them.

    Attributes:
        position: of the points, scene frame.
        material: of the points; it is not differentiated.
        pixel: their pixels, in the response of the capture.
        place: number of the place that each point shows, from 0 on. All points of a place have the same
            position and base colour. None if every point is a place of its own.
    """

    position: Float[Tensor, "N 3"]
    material: Material
    pixel: Float[Tensor, "N 3"]
    place: Int[Tensor, " N"] | None = None

    def __getitem__(self, rows: Tensor | slice) -> Target:
        place = None if self.place is None else self.place[rows].unique(return_inverse=True)[1]
        return Target(self.position[rows], self.material[rows], self.pixel[rows], place)


@dataclass(frozen=True)
class Objective:
    """The terms that a light fit minimises.

    Attributes:
        response: response of the capture, "linear" or "srgb".
        unit: change of a typical pixel per unit of log radiance (`response_slope`); for a linear response
            this is the pixel value itself. The denominator of relative errors depends on it.
        steps: optimisation steps of `fit.fit_light`.
        base_color_known: whether the base colours are correct up to one factor per channel. If False, a fit
            also estimates the base colour of each point.
        sky: what cameras saw of the map directly; None if they saw nothing of it.
        monochrome: whether the map has one channel for all three colours.
        log_scale: mean logarithm of the factors that a fit applies to the base colours; 0 keeps their scale.
            None if it is free, because cameras saw enough of the map to fix the scale.
    """

    response: str
    unit: float
    steps: int = STEPS
    base_color_known: bool = False
    sky: KnownSky | None = None
    monochrome: bool = False
    log_scale: float | None = 0.0

    def relative_error(
        self,
        strength: Float[Tensor, "T 3"],
        transport: Transport,
        target: Target,
        gain: Float[Tensor, "#N 3"] | float,
    ) -> Float[Tensor, "N 3"]:
        """The error of the rendered pixels relative to the recorded ones.

        A clipped pixel is a lower bound: a render above it has no error (see `shading.color.residual`).

        Args:
            strength: strengths of the T sources.
            transport: from the sources to the points.
            target: the points and their pixels.
            gain: factor on the base colour of the points.
        """
        material = target.material
        scaled = Material((material.base_color * gain).clamp(0, 1), material.roughness, material.metallic)
        error = residual(transport.outgoing(scaled, strength), target.pixel, self.response)
        return error / error_unit(target.pixel, self.response, self.unit)

    def misfit(
        self,
        strength: Float[Tensor, "T 3"],
        transport: Transport,
        target: Target,
        gain: Float[Tensor, "#N 3"],
    ) -> Float[Tensor, ""]:
        """The data term: the mean Huber loss of the relative error. Arguments as in `relative_error`."""
        error = self.relative_error(strength, transport, target, gain)
        return functional.smooth_l1_loss(error, torch.zeros_like(error), beta=OUTLIER_ERROR)

    def map_prior(self, log_radiance: Float[Tensor, "3 H W"]) -> Float[Tensor, ""]:
        """Priors on the map: smoothness, and agreement with what cameras saw of it directly."""
        uneven = SMOOTHNESS * total_variation(log_radiance)
        if self.sky is None or not log_radiance.numel():
            return uneven
        return uneven + SKY_WEIGHT * self.sky.misfit(log_radiance)

    def lamp_prior(
        self, contribution: Float[Tensor, " M"], all_light: Float[Tensor, " 3"]
    ) -> Float[Tensor, ""]:
        """Sparsity prior on the lamps, and the prior that all light together is close to white.

        The sparsity prior Σ ln(1 + share / s) is concave in each share, so that one strong lamp costs less
        than two lamps of half its strength.

        Args:
            contribution: mean light that each lamp brings to the points.
            all_light: mean light that all sources bring to the points.
        """
        share = contribution / all_light.mean()
        lamps = SPARSITY * (share / LINEAR_SHARE).log1p().sum()
        return lamps + WHITENESS * tint(all_light)


def error_unit(pixel: Float[Tensor, "*B 3"], response: str, typical: float) -> Float[Tensor, "*B 3"]:
    """The error of a pixel that counts as a relative error of 1.

    Args:
        pixel: pixel values, in the capture's response.
        response: response of the capture, "linear" or "srgb".
        typical: change of a typical pixel per unit of log radiance (`response_slope`).
    """
    return response_slope(pixel, response) + ERROR_FLOOR * typical


def total_variation(values: Float[Tensor, "C H W"]) -> Float[Tensor, ""]:
    """Σ |difference of neighbouring texels| divided by the number of texels; the map wraps in azimuth."""
    across = torch.cat((values, values[..., :1]), -1).diff(dim=-1)
    down = values.diff(dim=1)
    texels = max(1, values[0].numel())
    return sum(_smooth_abs(difference).sum() for difference in (across, down)) / texels


def nearest_points(position: Float[Tensor, "N 3"]) -> Int[Tensor, "N K"]:
    """Indices of the `NEIGHBORS` nearest other points of each point (of all others if there are fewer)."""
    distance = torch.cdist(position, position).fill_diagonal_(torch.inf)
    return distance.topk(min(NEIGHBORS, len(position) - 1), largest=False).indices


def unevenness(base_color: Float[Tensor, "N 3"], nearest: Int[Tensor, "N K"]) -> Float[Tensor, ""]:
    """Mean |difference of log base colour| between neighbours.

    Because of the absolute value, a sharp edge costs as much as a gradual change of the same total size.
    """
    logarithm = base_color.clamp_min(DARK_FLOOR).log()
    difference = logarithm[:, None] - logarithm[nearest]
    return _smooth_abs(difference).sum() / max(1, difference.numel())


def _smooth_abs(difference: Float[Tensor, ...]) -> Float[Tensor, ...]:
    return (difference.square() + QUADRATIC_BELOW**2).sqrt()


def white_balance(
    contribution: Float[Tensor, "T 3"], all_light: Float[Tensor, " 3"], response: str
) -> Float[Tensor, ""]:
    """Prior on the colours of a map if the images have display values, else 0.

    The prior is the mean deviation of the texels from white, as in `tint`. Coloured sources may add up to
    white light, such as an orange sky and a blue lamp, and then tint surfaces by their orientation.

    Args:
        contribution: mean light that each texel brings to the points.
        all_light: mean light that all sources bring to the points; a texel counts by its share of it.
        response: response of the capture, "linear" or "srgb".
    """
    if response != "srgb":
        return all_light.new_zeros(())
    brightness = contribution.mean(-1, keepdim=True)
    relative = contribution / brightness.clamp_min(1e-20) + PALE_SHARE
    share = brightness[:, 0] / all_light.mean()
    return BALANCE * (share * tint(relative)).sum()


def tint(light: Float[Tensor, "*B 3"]) -> Float[Tensor, "*B"]:
    """Deviation of colours from white: the variance of their logarithms over the channels."""
    return light.clamp_min(1e-20).log().var(-1, correction=0)
