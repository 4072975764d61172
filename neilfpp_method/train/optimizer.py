"""What training loops have in common: Adam with a rate for each field, and the seed of a step."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import torch
from torch import Tensor

from neilfpp_method.model import NeilfModel
from neilfpp_method.schedule import Stage, StagePosition, rate_factor
from neilfpp_method.settings.types import OptimizerConfig

__all__ = ["adam", "gradient_norms", "make_optimizer", "seed_step", "set_rates"]


def make_optimizer(model: NeilfModel, config: OptimizerConfig) -> torch.optim.Optimizer:
    """Adam with a named group for each field; frozen parameters get no gradient and do not move."""
    groups = [
        {"params": parameters, "name": name, "lr": getattr(config, name)}
        for name, parameters in model.parameter_groups().items()
        if parameters
    ]
    return adam(groups)


def adam(groups: Sequence[Mapping[str, object]]) -> torch.optim.Adam:
    """Adam as every loop here uses it.

    Fused: one pass over the tables of hash grids, which are most of all parameters, in place of a dozen.
    """
    return torch.optim.Adam(groups, betas=(0.9, 0.99), eps=1e-15, fused=True)


def set_rates(
    optimizer: torch.optim.Optimizer,
    config: OptimizerConfig,
    position: StagePosition,
    background_waits: bool = True,
) -> None:
    """The rate of each field at a step of a stage.

    `background_waits` off: what lies beyond the scene moves from the start, whatever `config.background_from`
    says. Where structure from motion has found points there, one colour is no stand-in for it: training would
    fill the scene with clouds.
    """
    factor = rate_factor(config, position)
    waits = background_waits and position.stage is Stage.SDF_INIT and position.share < config.background_from
    for group in optimizer.param_groups:
        name = group["name"]
        group["lr"] = 0.0 if waits and name == "background" else getattr(config, name) * factor


def seed_step(seed: int, step: int, rank: int = 0) -> None:
    """Seed every random number of a step: what a step draws depends on these three numbers alone."""
    torch.manual_seed((seed * 1_000_003 + step) * 4_099 + rank)


def gradient_norms(model: NeilfModel) -> dict[str, Tensor]:
    """Length of the gradient of each field that has one."""
    norms = {}
    for name, parameters in model.parameter_groups().items():
        gradients = [p.grad for p in parameters if p.grad is not None]
        if gradients:
            norms[name] = torch.stack([g.norm() for g in gradients]).norm()
    return norms
