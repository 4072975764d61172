"""Gradient descent on a light, together with a factor on the base colour of every surface point.

The base colour was learned under the previous light. The error of a lamp in the wrong place is therefore
compensated by the base colour, and a fit with that base colour would put the lamp in the same place again. So
a fit keeps only the mean base colour. At each point the base colour is free, under a prior that it resembles
that of the neighbouring points: surfaces mostly consist of few materials, and light changes slowly along them
(Land and McCann 1971, "Lightness and Retinex Theory").
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import torch
from jaxtyping import Float, Int
from torch import Tensor

from neilfpp_method.lighting.objective import EVENNESS, Objective, Target, nearest_points, unevenness

__all__ = ["Descended", "Unknown", "descend"]

FINAL_RATE_SHARE = 0.05
"""Learning rate of the last step as a share of that of the first."""


@dataclass(frozen=True)
class Unknown:
    """A leaf tensor that is optimised, and its learning rate in the first step."""

    value: Tensor
    rate: float


@dataclass(frozen=True)
class Descended:
    """The end of a descent.

    Attributes:
        loss: the loss before the last step.
        log_scale: mean logarithm of the factors on the base colours, after the last step.
    """

    loss: float
    log_scale: float


def descend(
    unknowns: Sequence[Unknown],
    gain_rate: float,
    steps: int,
    target: Target,
    objective: Objective,
    loss_of: Callable[[Float[Tensor, "#N 3"]], Float[Tensor, ""]],
) -> Descended:
    """Minimise a loss over the unknowns and over factors ("gains") on the base colour of the points.

    Every place has a gain per channel; if the base colours are known, all places share it. The mean
    logarithm of the gains is `objective.log_scale`, because the pixels of the points hardly determine
    the common scale of light and base colour.

    Args:
        unknowns: the tensors to optimise, in place.
        gain_rate: learning rate of the logarithms of the gains.
        steps: number of Adam steps.
        target: the surface points; their base colour and positions define the evenness prior.
        objective: says whether base colours are known, and which scale of them is kept.
        loss_of: the other terms of the loss, as a function of the gains.
    """
    scale = objective.log_scale
    known, base_color = objective.base_color_known, target.material.base_color
    place = torch.arange(len(base_color), device=base_color.device) if target.place is None else target.place
    point = _one_point_each(place)
    base_color = base_color[point]
    log_gain = torch.zeros_like(base_color[:1] if known else base_color, requires_grad=True)
    nearest = None if known else nearest_points(target.position[point])
    groups = [{"params": [u.value], "lr": u.rate} for u in (*unknowns, Unknown(log_gain, gain_rate))]
    optimizer = torch.optim.Adam(groups, betas=(0.9, 0.99), fused=True)
    schedule = torch.optim.lr_scheduler.ExponentialLR(optimizer, FINAL_RATE_SHARE ** (1 / steps))
    with torch.enable_grad():
        for _ in range(steps):
            gain = (log_gain if scale is None else log_gain - log_gain.mean() + scale).exp()
            loss = loss_of(gain if known else gain[place])
            if nearest is not None:
                loss = loss + EVENNESS * unevenness(base_color * gain, nearest)
            optimizer.zero_grad()
            loss.backward()
            optimizer.step()
            schedule.step()
    return Descended(loss.item(), log_gain.mean().item() if scale is None else scale)


def _one_point_each(place: Int[Tensor, " N"]) -> Int[Tensor, " P"]:
    """Index of one of the points of each place."""
    count = int(place.max()) + 1 if len(place) else 0
    return place.new_zeros(count).scatter(0, place, torch.arange(len(place), device=place.device))
