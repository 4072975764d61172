"""Light is solved for, not descended to: a map and lamps under which remembered points look as the images show them.

What is known of light in general takes no side in the factor between light and base colour: the total variation of the map
is of logarithms, lamps pay for their share of all light, and the tint is of ratios. A price per amount of light would make
the light dimmer and surfaces brighter at every fit, as the base colour follows.

With the transport of these points at hand (`lighting.transport`), a hundred steps on the light cost less than as many steps
of training. They find lamps that stochastic descent, through few and noisy samples of every texel, spreads into a haze that
the base colour then makes up for.
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

__all__ = ["Evidence", "Light", "Target", "compare", "evidence", "fit_light", "tint", "total_variation"]

SMOOTHED = 1e-2
"""Differences of log radiance below this count by their square, so that the total variation has a gradient everywhere."""
LEAST_RATE = 0.05
"""The last step's rate over the first's."""
LEAST_REACH = 0.05
"""A lamp that brings less than this share of the mean, were all alike, is not sought: behind a wall anything fits."""
LEAST_GAIN = 0.01
"""Of the relative error: lamps that explain less than a hundredth are no lamps."""
FEWEST = 20
"""Points kept back that say something."""
LEAST_SIGHT = 0.05
"""Share of the points that see a texel which the images may set. A few can ask anything of what only they see, and would make
suns of it for the sake of one pixel; it takes after its surroundings."""
FIRST_SHARE = 0.1
"""Of the light that typical points receive, what all lamps that are not yet lit start with together."""
SMALL_SHARE = 0.02
"""Of all light: a lamp that brings less pays for what it brings, one that brings much more hardly for more than being there."""


@dataclass(frozen=True)
class Light:
    """A map, log radiance of its texels, and the intensity of lamps."""

    log_radiance: Float[Tensor, "3 H W"]
    intensity: Float[Tensor, "M 3"]

    def strength(self) -> Float[Tensor, "T 3"]:
        """Of all sources: radiance of the texels row by row, then intensity of the lamps."""
        return torch.cat((self.log_radiance.exp().flatten(1).t(), self.intensity))


@dataclass(frozen=True)
class Target(Indexable):
    """What points look like: their material, constants, and their pixels in the response of the capture."""

    material: Material
    pixel: Float[Tensor, "N 3"]

    def __getitem__(self, rows: Tensor | slice) -> Target:
        return Target(self.material[rows], self.pixel[rows])


@dataclass(frozen=True)
class Evidence:
    """How much lower the relative error of the second of two lights is at `points` that neither was fitted to, and the
    standard error of that mean."""

    gain: float
    deviation: float
    points: int

    def favours(self, chosen: bool) -> bool:
        """Whether to take the more complicated light; `chosen`: it is what surfaces have learned under so far.

        To be chosen it must gain more than chance brings about once in forty times, and enough to be worth it; to stay, it
        may well do so.
        """
        if self.points < FEWEST:
            return False
        if chosen:
            return self.gain + 2 * self.deviation > LEAST_GAIN
        return self.gain > max(2 * self.deviation, LEAST_GAIN)


def evidence(gain: Float[Tensor, " N"]) -> Evidence:
    """What the gains of points add up to; without any, nothing speaks for either light."""
    if not len(gain):
        return Evidence(0.0, 0.0, 0)
    return Evidence(gain.mean().item(), (gain.std(correction=0) / len(gain) ** 0.5).item(), len(gain))


def fit_light(
    start: Light, carried: Transport, target: Target, response: str, unit: float, config: LightFitConfig
) -> Light:
    """The light that explains the points best, the smoothest and with the fewest lamps where they do not say.

    Minimises the relative error, robustly; the total variation of the map's log radiance, so that lamps in it may be sharp
    and what no point sees takes after its surroundings; Σ ln(1 + share/s) over the lamps' shares of all light, a concave
    price for which one strong lamp is cheaper than two half as strong; and the tint of all light that reaches the points,
    which images hardly tell from that of the surfaces. Base colour and light share a scale, so a factor per channel on the
    base colour is free during the fit: the light need not make up for it.

    Args:
        start: where the search starts.
        carried: from the texels of the map, row by row, and then from the lamps.
        target: what the points look like.
        response: of the capture, "linear" or "srgb".
        unit: a pixel of typical brightness; errors are relative to the pixel and a share of this.
        config: weights, rates and number of steps.

    Returns:
        `start` where the search leads to what is not finite, or there is no point.
    """
    if not len(target.pixel):
        return start
    texels = start.log_radiance[0].numel()
    log_radiance = start.log_radiance.clone().requires_grad_()
    # In units of what a lamp brings to a white surface in the mean over the points: its unknowns are then of one size.
    brought = carried.sources[0, :, texels:].mean(0)[:, None] / unit
    reaches = brought > LEAST_REACH * brought.mean()
    first = FIRST_SHARE / max(1, len(brought))
    root = (start.intensity * brought).clamp_min(first).sqrt().requires_grad_()
    log_gain = torch.zeros(3, device=root.device, requires_grad=True)
    groups = [{"params": [p], "rate": rate * config.rate} for p, rate in ((log_radiance, 1.0), (root, 0.5), (log_gain, 0.2))]
    optimizer = torch.optim.Adam(groups, betas=(0.9, 0.99))
    # What a wall or the ground hides from all points has no part in how they look: half of the texels over a table.
    felt = torch.nonzero(carried.sources.amax((0, 1)))[:, 0]
    carried = carried.of(felt)
    reaching = carried.sources[0].mean(0)
    told = ((carried.sources[0] > 0).float().mean(0) > LEAST_SIGHT) | (felt >= texels)
    told = told[:, None]

    def light() -> Light:
        return Light(log_radiance, torch.where(reaches, root.square() / brought.clamp_min(1e-20), 0.0))

    with torch.enable_grad():
        for step in range(config.steps):
            for group in optimizer.param_groups:
                group["lr"] = group["rate"] * LEAST_RATE ** (step / config.steps)
            strength = light().strength()[felt]
            strength = torch.where(told, strength, strength.detach())
            error = _relative_error(strength, carried, target, log_gain.exp(), response, unit, config)
            loss = functional.smooth_l1_loss(error, torch.zeros_like(error), beta=config.outlier)
            loss = loss + config.smoothness * total_variation(log_radiance)
            brings = reaching @ strength
            share = unit * root.square().mean(-1) / brings.mean()
            loss = loss + config.sparsity * (share / SMALL_SHARE).log1p().sum()
            loss = loss + config.whiteness * tint(brings)
            optimizer.zero_grad()
            loss.backward()
            optimizer.step()
    found = light()
    found = Light(found.log_radiance.detach(), found.intensity.detach())
    finite = found.log_radiance.isfinite().all() and found.intensity.isfinite().all()
    return found if finite else start


@torch.no_grad()
def compare(
    lights: tuple[Light, Light],
    carried: tuple[Transport, Transport],
    target: Target,
    response: str,
    unit: float,
    config: LightFitConfig,
) -> Float[Tensor, " N"]:
    """How much lower the relative error of the second of two lights is, at points that neither was fitted to."""
    one, other = (
        _relative_error(light.strength(), transport, target, 1.0, response, unit, config).abs().clamp_max(1).mean(-1)
        for light, transport in zip(lights, carried, strict=True)
    )
    return one - other


def total_variation(values: Float[Tensor, "C H W"]) -> Float[Tensor, ""]:
    """Σ |difference of neighbours| per texel, of a map that is closed in azimuth."""
    across = torch.cat((values, values[..., :1]), -1).diff(dim=-1)
    down = values.diff(dim=1)
    size = max(1, values[0].numel())
    return sum((step.square() + SMOOTHED**2).sqrt().sum() for step in (across, down)) / size


def tint(light: Float[Tensor, " 3"]) -> Float[Tensor, ""]:
    """How far light is from white: the variance of its logarithm over the channels."""
    return light.clamp_min(1e-20).log().var(correction=0)


def _relative_error(
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
