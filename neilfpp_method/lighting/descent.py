"""Descent of a light fit, with a factor on the base colour of every point as an unknown beside the light.

Surfaces have learned their base colour under the light so far: a lamp in the wrong place leaves its glow in
it, which then holds the lamp there. So a fit keeps the mean base colour and asks of each point only that it
is like its neighbours: surfaces are mostly made of few materials, and light changes slowly along them (Land
and McCann 1971, "Lightness and Retinex Theory").
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import torch
from jaxtyping import Float
from torch import Tensor

from neilfpp_method.lighting.objective import Objective, Target, nearest_points, unevenness

__all__ = ["Unknown", "descend"]

FINAL_RATE_SHARE = 0.05
"""Rate of the last step over that of the first."""


@dataclass(frozen=True)
class Unknown:
    """Leaves of the graph, and their rate in the first step."""

    value: Tensor
    rate: float


def descend(
    unknowns: Sequence[Unknown],
    gain_rate: float,
    steps: int,
    target: Target,
    objective: Objective,
    loss_of: Callable[[Float[Tensor, "#N 3"]], Float[Tensor, ""]],
) -> Float[Tensor, ""]:
    """Move the unknowns to where a loss is least, and with them factors on the base colour of the points.

    Every point has factors of its own; all share one per channel where the weight of evenness is 0. The mean
    of their logarithms is 0: light and base colour share a scale, and surfaces have learned what there is to
    know of it. Where cameras saw some of the light itself it is free.

    Args:
        unknowns: what moves, in place.
        gain_rate: rate of the logarithms of the factors.
        steps: how many.
        target, objective: whose base colour is to be even, and how much that weighs.
        loss_of: all that speaks against the unknowns, from the factors.

    Returns:
        The loss before the last step.
    """
    weight, base_color = objective.config.evenness, target.material.base_color
    log_gain = torch.zeros_like(base_color if weight > 0 else base_color[:1], requires_grad=True)
    nearest = nearest_points(target.position) if weight > 0 else None
    groups = [{"params": [u.value], "lr": u.rate} for u in (*unknowns, Unknown(log_gain, gain_rate))]
    optimizer = torch.optim.Adam(groups, betas=(0.9, 0.99), fused=True)
    falling = torch.optim.lr_scheduler.ExponentialLR(optimizer, FINAL_RATE_SHARE ** (1 / steps))
    with torch.enable_grad():
        for _ in range(steps):
            gain = (log_gain - log_gain.mean() if objective.sky is None else log_gain).exp()
            loss = loss_of(gain)
            if nearest is not None:
                loss = loss + weight * unevenness(base_color * gain, nearest)
            optimizer.zero_grad()
            loss.backward()
            optimizer.step()
            falling.step()
    return loss.detach()
