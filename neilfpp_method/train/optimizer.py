"""Parts that all training loops share: Adam with a learning rate per field, and the seed of a step."""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence
from enum import IntEnum

import torch
from torch import Tensor

from neilfpp_method.hosts.base import Host, LimitsSurfaceWidth, StartsFromShape
from neilfpp_method.model import NeilfModel
from neilfpp_method.schedule import Stage, StagePosition, learning_rate, rate_factor, surface_width_limit
from neilfpp_method.settings.types import NeilfConfig, OptimizerConfig

__all__ = [
    "Stream",
    "adam",
    "gradient_norms",
    "limit_surface_width",
    "make_optimizer",
    "seed_step",
    "seed_stream",
    "set_rates",
    "waiting_fields",
]

GEOMETRY_FROM = 0.1
"""Share of SDF init after which G and β are trained, if G starts from a hull."""
MIN_WAIT = 60
"""Smallest number of these steps, but at most half of the stage. In a stage of 230 steps, `spot_city`
vanished after a wait of 23 steps; after 60 steps its normals are off by 14° to 15°.
"""


def make_optimizer(model: NeilfModel, config: OptimizerConfig) -> torch.optim.Optimizer:
    """Make Adam with a named parameter group for each field.

    Frozen parameters are included; they receive no gradient and are not changed.
    """
    groups = [
        {"params": parameters, "name": name, "lr": learning_rate(config, name)}
        for name, parameters in model.parameter_groups().items()
        if parameters
    ]
    return adam(groups)


def adam(groups: Sequence[Mapping[str, object]]) -> torch.optim.Adam:
    """Make Adam with the options that every training loop of this package uses.

    The fused implementation makes one pass over the parameters instead of a dozen. Most parameters are
    tables of hash grids, for which this matters.
    """
    return torch.optim.Adam(groups, betas=(0.9, 0.99), eps=1e-15, fused=True)


def set_rates(
    optimizer: torch.optim.Optimizer,
    config: OptimizerConfig,
    position: StagePosition,
    waiting: Collection[str] = (),
) -> None:
    """Set the learning rate of each field for a step of a stage.

    Args:
        optimizer: an optimizer with a group per field, as `make_optimizer` returns it.
        config: the learning rates and their schedule.
        position: the stage and the step within it.
        waiting: fields that stay fixed in this step, see `waiting_fields`.
    """
    factor = rate_factor(config, position)
    for group in optimizer.param_groups:
        name = group["name"]
        group["lr"] = 0.0 if name in waiting else learning_rate(config, name) * factor


def waiting_fields(model: NeilfModel, config: OptimizerConfig, position: StagePosition) -> set[str]:
    """Name the fields that a step of SDF init does not train yet.

    The background waits until surfaces exist (`config.background_from`), except if geometry starts from a
    hull, or if structure from motion has found points behind the scene: a constant colour does not represent
    such a background, and training would explain it by density within the scene instead.

    Geometry waits for R (`GEOMETRY_FROM`, `MIN_WAIT`) if it starts from a hull. While R does not yet vary
    with direction, a mirror is best explained by a dent with the depth of what it reflects, and later
    training does not remove such a dent. With an R that is nearly untrained, the surface may vanish.
    """
    if position.stage is not Stage.SDF_INIT:
        return set()
    waiting = set()
    starts_from_shape = isinstance(model.host, StartsFromShape) and model.host.starts_from_shape
    if position.share < config.background_from and not (model.facts.far_points or starts_from_shape):
        waiting.add("background")
    wait = max(GEOMETRY_FROM * position.length, min(MIN_WAIT, position.length / 2))
    if position.step < wait and starts_from_shape:
        waiting |= {"geometry", "beta"}
    return waiting


def limit_surface_width(host: Host, config: NeilfConfig, position: StagePosition) -> None:
    """Limit the width of a host's surface to that of the schedule (`schedule.surface_width_limit`).

    Hosts whose surface has no soft layer that can be limited are not changed.
    """
    if isinstance(host, LimitsSurfaceWidth):
        host.limit_surface_width(surface_width_limit(config.host.volume, position))


def seed_step(seed: int, step: int, rank: int = 0) -> None:
    """Seed the random number generator of torch for a step.

    What a step draws depends only on the seed of the run, the number of the step, and the rank of the
    process. So a resumed run draws the same numbers as one that was never interrupted.
    """
    torch.manual_seed((seed * 1_000_003 + step) * 4_099 + rank)


class Stream(IntEnum):
    """Random numbers that are not drawn by training steps: for initial weights, and for measurements."""

    WEIGHTS = 1
    HEALTH = 2
    SURFACE = 3
    LIGHT = 4
    MATERIAL = 5
    SEARCH = 6
    POSES = 7


def seed_stream(seed: int, stream: Stream, step: int = 0) -> None:
    """Seed the random number generator for a measurement after `step` steps, apart from that of any step.

    Measurements after the same step have different numbers. Those after different steps have the same only if
    the steps differ by as much as the streams, at most 6, which no schedule of usual length has.
    """
    seed_step(seed, -stream - step)


def gradient_norms(model: NeilfModel) -> dict[str, Tensor]:
    """L2 norm of the gradient of each field that has one."""
    norms = {}
    for name, parameters in model.parameter_groups().items():
        gradients = [p.grad for p in parameters if p.grad is not None]
        if gradients:
            norms[name] = torch.stack([g.norm() for g in gradients]).norm()
    return norms
