"""How a fit moves: with the base colour of the points unknown beside the light.

What surfaces have learned so far they have learned under the light so far: a lamp in the wrong place leaves its glow in their
base colour, which then holds it there. So a fit takes from them what the base colour is in the mean, and asks of each point
no more than that it is like its neighbours: surfaces are mostly made of few materials, and light changes slowly along them
(Land and McCann 1971, "Lightness and Retinex Theory"). What is left over when the fit ends is for the surfaces to learn.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import torch
from jaxtyping import Float
from torch import Tensor

from neilfpp_method.lighting.objective import Objective, Target, nearest_points, unevenness

__all__ = ["Unknown", "descend"]

LEAST_RATE = 0.05
"""The last step's rate over the first's."""


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

    Every point has factors of its own; all share one per channel where the weight of evenness is 0. The mean of their
    logarithms is 0: light and base colour share a scale, and surfaces have learned what there is to know of it. Where cameras
    saw some of the light itself it is free.

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
    falling = torch.optim.lr_scheduler.ExponentialLR(optimizer, LEAST_RATE ** (1 / steps))
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
