"""Fit an environment map and lamps to the pixels of remembered surface points.

Once the transport to these points is computed (`lighting.transport`), a hundred steps on the light cost less
than a hundred training steps. Stochastic gradient descent during training would use few and noisy samples of
every texel: it blurs a lamp over many texels, and the base colour then compensates for the missing shadows. A
fit avoids this.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import torch
from jaxtyping import Bool, Float
from torch import Tensor
from torch.nn import functional

from neilfpp_method.lighting.decision import is_worthwhile
from neilfpp_method.lighting.descent import Unknown, descend
from neilfpp_method.lighting.objective import Objective, Target, white_balance
from neilfpp_method.lighting.transport import Transport

__all__ = [
    "MIN_REACH",
    "CarriedLight",
    "Evidence",
    "MapAndLamps",
    "error_reduction",
    "evidence",
    "fit_light",
]

RATE = 0.1
"""Learning rate of log radiance in the first step of a fit."""
ROOT_RATE = 0.5
"""Learning rate of the square roots of the lamps' contributions, as a multiple of `RATE`."""
GAIN_RATE = 0.1
"""Learning rate of the logarithms of the factors on base colour, as a multiple of `RATE`."""
MIN_REACH = 0.05
"""A lamp whose contribution at intensity 1 is below this share of the mean over all lamps gets no intensity:
a lamp that is visible from hardly any point, such as one behind a wall, fits the images with any intensity.
"""
MIN_GAIN = 0.01
"""Smallest reduction of the mean relative error for which lamps are kept."""
MIN_VISIBLE_SHARE = 0.05
"""Share of the points from which a texel must be visible for the images to determine it. Texels below this
share are determined by the smoothness prior only.
"""
FIRST_SHARE = 0.1
"""Initial contribution of all candidate lamps together, as a share of the light that a typical point
receives.
"""


@dataclass(frozen=True)
class MapAndLamps:
    """The parameters of a map and M lamps.

    Attributes:
        log_radiance: logarithm of the radiance of each texel.
        intensity: radiant intensity of each lamp.
        log_scale: mean logarithm of the factors on the base colours with which a fit found this light.
    """

    log_radiance: Float[Tensor, "3 H W"]
    intensity: Float[Tensor, "M 3"]
    log_scale: float = 0.0

    def strength(self) -> Float[Tensor, "T 3"]:
        """The strengths of all sources: radiance of the texels row by row, then intensity of the lamps."""
        return torch.cat((self.log_radiance.exp().flatten(1).t(), self.intensity))


@dataclass(frozen=True)
class Evidence:
    """Comparison of a light with lamps against one without, on data to which neither was fitted.

    Attributes:
        gain: mean reduction of the relative error by the lamps.
        deviation: standard error of that mean.
        points: number of held-back points.
        in_views: whether the points were compared in held-back views, with base colours fitted in others.
    """

    gain: float
    deviation: float
    points: int
    in_views: bool = False

    def favours(self, chosen: bool) -> bool:
        """Whether the light with lamps should be used; not if there are too few points (`is_worthwhile`).

        Args:
            chosen: whether lamps are in use now.
        """
        found = is_worthwhile(
            benefit=self.gain,
            deviation=self.deviation,
            threshold=MIN_GAIN,
            samples=self.points,
            chosen=chosen,
        )
        return found is True


def evidence(gain: Float[Tensor, " N"]) -> Evidence:
    """Mean and standard error of the gains of N points."""
    if not len(gain):
        return Evidence(0.0, 0.0, 0)
    return Evidence(gain.mean().item(), (gain.std(correction=0) / len(gain) ** 0.5).item(), len(gain))


def fit_light(start: MapAndLamps, transport: Transport, target: Target, objective: Objective) -> MapAndLamps:
    """Find the light that best explains the pixels of surface points.

    The minimised sum (see `objective`) consists of

    - a robust loss of the relative error of the pixels,
    - the total variation of the map's log radiance, which permits sharp edges and gives a texel that no
      point sees the radiance of its neighbours,
    - the deviation of the map from what cameras saw of it directly,
    - the unevenness of base colour, which is free during the fit (see `descent`),
    - priors on the lamps and on the tint of the light, which the images hardly separate from the tint of
      the surfaces.

    Args:
        start: initial value.
        transport: from the texels of the map, row by row, followed by the lamps.
        target: the points and their pixels.
        objective: the terms, and the number of steps.

    Returns:
        The fitted light; `start` if there are no points or the result is not finite.
    """
    start = replace(start, log_scale=objective.log_scale or 0.0)
    if not len(target.pixel):
        return start
    unit = objective.unit
    texels = start.log_radiance[0].numel()
    channels = start.log_radiance.clone()
    log_radiance = channels.mean(0, keepdim=True) if objective.monochrome else channels
    log_radiance.requires_grad_()
    # The unknown of a lamp is its mean contribution to a white surface, in units of a typical pixel, so that
    # one learning rate suits all lamps. Its square root is optimised, which keeps it non-negative.
    reach = transport.sources[0, :, texels:].mean(0)[:, None] / unit
    is_reachable = reach > MIN_REACH * reach.mean()
    first = FIRST_SHARE / max(1, len(reach))
    root = (start.intensity * reach).clamp_min(first).sqrt().requires_grad_()
    reaching_any = transport.reaching_any()
    is_visible = _visible_share(transport.sources[0], start.log_radiance) > MIN_VISIBLE_SHARE
    set_by_images = is_visible[reaching_any, None]
    transport = transport.select_sources(reaching_any)
    mean_transport = transport.sources[0].mean(0)

    def light() -> MapAndLamps:
        colored = log_radiance.expand_as(start.log_radiance)
        return MapAndLamps(colored, torch.where(is_reachable, root.square() / reach.clamp_min(1e-20), 0.0))

    def loss_of(gain: Float[Tensor, "#N 3"]) -> Float[Tensor, ""]:
        strength = light().strength()[reaching_any]
        strength = torch.where(set_by_images, strength, strength.detach())
        loss = objective.misfit(strength, transport, target, gain)
        loss = loss + objective.map_prior(log_radiance.expand_as(start.log_radiance))
        contribution = mean_transport[:, None] * strength
        all_light = contribution.sum(0)
        loss = loss + white_balance(contribution[reaching_any < texels], all_light, objective.response)
        return loss + objective.lamp_prior(unit * root.square().mean(-1), all_light)

    unknowns = (Unknown(log_radiance, RATE), Unknown(root, ROOT_RATE * RATE))
    end = descend(unknowns, GAIN_RATE * RATE, objective.steps, target, objective, loss_of)
    fitted = light()
    fitted = MapAndLamps(fitted.log_radiance.detach(), fitted.intensity.detach(), end.log_scale)
    finite = fitted.log_radiance.isfinite().all() and fitted.intensity.isfinite().all()
    return fitted if finite else start


def _visible_share(
    diffuse: Float[Tensor, "N T"], log_radiance: Float[Tensor, "3 H W"]
) -> Float[Tensor, " T"]:
    """Share of the points that see each source; 1 for lamps.

    A point has fewer rays than there are texels, so a texel counts as visible if a ray reached it or one of
    its neighbours.

    Args:
        diffuse: the diffuse part of the transport from the texels, row by row, followed by the lamps.
        log_radiance: gives the size of the map.
    """
    _, height, width = log_radiance.shape
    texels = height * width
    share = diffuse.new_ones(diffuse.shape[1])
    if texels:
        reached = (diffuse[:, :texels] > 0).to(diffuse.dtype).view(-1, 1, height, width)
        around = functional.pad(reached, (1, 1, 0, 0), mode="circular")
        share[:texels] = functional.max_pool2d(around, 3, 1, (1, 0)).mean(0).flatten()
    return share


@dataclass(frozen=True)
class CarriedLight:
    """A light, and the transport from its sources to N points."""

    light: MapAndLamps
    transport: Transport

    def __getitem__(self, rows: Bool[Tensor, " N"]) -> CarriedLight:
        """The light at some of the points."""
        return CarriedLight(self.light, self.transport[rows])

    def with_light(self, light: MapAndLamps) -> CarriedLight:
        """Another light from the same sources."""
        return CarriedLight(light, self.transport)

    def fit(self, target: Target, objective: Objective) -> MapAndLamps:
        """Find the light that best explains the points (`fit_light`), from this light on."""
        return fit_light(self.light, self.transport, target, objective)


@torch.no_grad()
def error_reduction(
    first: CarriedLight, second: CarriedLight, target: Target, objective: Objective
) -> Float[Tensor, " N"]:
    """Relative error under the first light minus that under the second, at held-back points.

    The relative error of a channel is clipped at 1, so that a few outliers do not dominate the mean. Base
    colours have the scale with which each light was fitted: if the sky fixes the scale of the light, that of
    the base colours follows from the fit.

    Args:
        first, second: the two fitted lights at the held-back points.
        target: these points and their pixels.
        objective: defines the relative error.
    """

    def error(carried: CarriedLight) -> Float[Tensor, " N"]:
        light = carried.light
        gain = math.exp(light.log_scale)
        relative = objective.relative_error(light.strength(), carried.transport, target, gain)
        return relative.abs().clamp_max(1).mean(-1)

    return error(first) - error(second)
