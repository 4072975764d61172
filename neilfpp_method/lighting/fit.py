"""Light is solved for: a map and lamps under which remembered points look as the images show them.

With the transport of these points at hand (`lighting.transport`), a hundred steps on the light cost less than
as many steps of training. They find lamps that stochastic descent, through few and noisy samples of every
texel, spreads into a haze that the base colour then makes up for.
"""

from __future__ import annotations

from dataclasses import dataclass

import torch
from jaxtyping import Float
from torch import Tensor

from neilfpp_method.lighting.descent import Unknown, descend
from neilfpp_method.lighting.objective import Objective, Target
from neilfpp_method.lighting.transport import Transport

__all__ = ["MIN_POINTS", "Evidence", "Light", "compare", "evidence", "fit_light"]

RATE = 0.1
"""Of log radiance at the start of a fit; lamps and base colour move at these shares of it:"""
ROOT_RATE, GAIN_RATE = 0.5, 0.1
"""Rates of the roots of lamp contributions, and of log factors on base colour, over log radiance's."""
MIN_REACH = 0.05
"""A lamp that brings less than this share of the mean over all lamps, at equal intensity, is not sought:
behind a wall any intensity fits.
"""
MIN_GAIN = 0.01
"""Relative error that lamps must save: those that explain less than a hundredth are not kept."""
MIN_POINTS = 20
"""Points kept back from which something is concluded."""
MIN_VISIBLE_SHARE = 0.05
"""Share of points that must see a texel for images to set it; below, the smoothness prior alone does."""
FIRST_SHARE = 0.1
"""Of the light that typical points receive, what all lamps that are not yet lit start with together."""


@dataclass(frozen=True)
class Light:
    """A map, log radiance of its texels, and the intensity of lamps."""

    log_radiance: Float[Tensor, "3 H W"]
    intensity: Float[Tensor, "M 3"]

    def strength(self) -> Float[Tensor, "T 3"]:
        """Of all sources: radiance of the texels row by row, then intensity of the lamps."""
        return torch.cat((self.log_radiance.exp().flatten(1).t(), self.intensity))


@dataclass(frozen=True)
class Evidence:
    """How much lower the relative error of the second of two lights is at `points` that neither was fitted
    to, and the standard error of that mean.
    """

    gain: float
    deviation: float
    points: int

    def favours(self, chosen: bool) -> bool:
        """Whether to take the more complicated light; `chosen`: the one that surfaces learn under now.

        To be chosen it must gain more than chance brings about once in forty times, and enough to be worth
        it; to stay, it may well do so.
        """
        if self.points < MIN_POINTS:
            return False
        if chosen:
            return self.gain + 2 * self.deviation > MIN_GAIN
        return self.gain > max(2 * self.deviation, MIN_GAIN)


def evidence(gain: Float[Tensor, " N"]) -> Evidence:
    """What the gains of points add up to; without any, nothing speaks for either light."""
    if not len(gain):
        return Evidence(0.0, 0.0, 0)
    return Evidence(gain.mean().item(), (gain.std(correction=0) / len(gain) ** 0.5).item(), len(gain))


def fit_light(start: Light, carried: Transport, target: Target, objective: Objective) -> Light:
    """The light that explains the points best, the smoothest and with the fewest lamps where they do not say.

    Minimises the relative error, robustly; the total variation of the map's log radiance, so that lamps in it
    may be sharp and what no point sees takes after its surroundings; how far the map is from what cameras saw
    of it; the unevenness of base colour, which is free during the fit (`descent`); and the price of lamps and
    of tint, which images hardly tell from that of the surfaces (`objective`).

    Args:
        start: where the search starts.
        carried: from the texels of the map, row by row, and then from the lamps.
        target: what the points look like.
        objective: what is minimised; its settings have rates and the number of steps, too.

    Returns:
        `start` where the search leads to what is not finite, or there is no point.
    """
    if not len(target.pixel):
        return start
    config, unit = objective.config, objective.unit
    texels = start.log_radiance[0].numel()
    channels = start.log_radiance.clone()
    log_radiance = channels.mean(0, keepdim=True) if objective.monochrome else channels
    log_radiance.requires_grad_()
    # In units of a lamp's mean contribution to a white surface, so that its unknowns have one size.
    brought = carried.sources[0, :, texels:].mean(0)[:, None] / unit
    reaches = brought > MIN_REACH * brought.mean()
    first = FIRST_SHARE / max(1, len(brought))
    root = (start.intensity * brought).clamp_min(first).sqrt().requires_grad_()
    # Sources that reach no point take no part in the sum: half of the texels over a table.
    reaching_any = torch.nonzero(carried.sources.amax((0, 1)))[:, 0]
    carried = carried.of(reaching_any)
    mean_transport = carried.sources[0].mean(0)
    visible_share = (carried.sources[0] > 0).float().mean(0)
    set_by_images = ((visible_share > MIN_VISIBLE_SHARE) | (reaching_any >= texels))[:, None]

    def light() -> Light:
        colored = log_radiance.expand_as(start.log_radiance)
        return Light(colored, torch.where(reaches, root.square() / brought.clamp_min(1e-20), 0.0))

    def loss_of(gain: Float[Tensor, "#N 3"]) -> Float[Tensor, ""]:
        strength = light().strength()[reaching_any]
        strength = torch.where(set_by_images, strength, strength.detach())
        loss = objective.misfit(strength, carried, target, gain)
        loss = loss + objective.unlikely(log_radiance.expand_as(start.log_radiance))
        return loss + objective.price(unit * root.square().mean(-1), mean_transport @ strength)

    unknowns = (Unknown(log_radiance, RATE), Unknown(root, ROOT_RATE * RATE))
    descend(unknowns, GAIN_RATE * RATE, config.steps, target, objective, loss_of)
    found = light()
    found = Light(found.log_radiance.detach(), found.intensity.detach())
    finite = found.log_radiance.isfinite().all() and found.intensity.isfinite().all()
    return found if finite else start


@torch.no_grad()
def compare(
    lights: tuple[Light, Light], carried: tuple[Transport, Transport], target: Target, objective: Objective
) -> Float[Tensor, " N"]:
    """How much lower the second of two lights makes the relative error, at points kept from both fits."""
    one, other = (
        objective.relative_error(light.strength(), transport, target, 1.0).abs().clamp_max(1).mean(-1)
        for light, transport in zip(lights, carried, strict=True)
    )
    return one - other
