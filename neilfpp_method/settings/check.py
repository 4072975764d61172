"""Check a configuration before training: values out of range.

Settings that exclude each other cannot be written: each kind of light and of host has settings of its own.
Python does not check the types and choices of a dataclass, so they are checked here as those of a file are.
"""

from __future__ import annotations

import math
from dataclasses import asdict

from neilfpp_method.errors import UserError
from neilfpp_method.settings.plain import from_dict, to_dict
from neilfpp_method.settings.types import NeilfConfig

__all__ = ["check_config"]

COUNTS = {
    "train": ("rays", "checkpoint_every"),
    "shading": ("train_samples", "eval_samples"),
    "volume": ("samples",),
}
"""Settings that are at least 1, by group."""
INITIAL_VALUES = ("initial_base_color", "initial_metallic")
"""Settings of `brdf` between 0 and 1, without these bounds: the sigmoid of the field does not reach them."""
MAX_SEED = 2**32 - 1
"""Largest seed. The seed of a step is a multiple of it (`seed_step`) that must fit into 64 bits."""


def check_config(config: NeilfConfig) -> None:
    """Reject settings from which no model can be made, in every training loop.

    Raises:
        UserError: a value is out of range, has the wrong type, or is not one of the choices.
    """
    from_dict(NeilfConfig, to_dict(config))
    _check_ranges(config)
    if config.volume.beta_final < 0:
        raise UserError(
            f"--config.volume.beta-final is {config.volume.beta_final}", "set it to 0 (no bound) or more"
        )
    rates = config.optimizer
    if min(rates.final) <= 0 or min(rates.drops) < 0 or rates.warm_up < 0:
        raise UserError(
            f"--config.optimizer.final {rates.final}, drops {rates.drops}, warm-up {rates.warm_up}",
            "set every value of final above 0, and the others to 0 or more",
        )


def _check_ranges(config: NeilfConfig) -> None:
    for group, names in COUNTS.items():
        for name in names:
            _require(getattr(getattr(config, group), name) >= 1, config, group, name, "1 or more")
    _require(0 <= config.train.seed <= MAX_SEED, config, "train", "seed", f"0 to {MAX_SEED}")
    _require(0 <= config.shading.hit_share <= 1, config, "shading", "hit_share", "0 to 1")
    for name in INITIAL_VALUES:
        _require(0 < getattr(config.brdf, name) < 1, config, "brdf", name, "a number above 0 and below 1")
    for name in ("radius", "beta_init"):
        value = getattr(config.volume, name)
        _require(0 < value < math.inf, config, "volume", name, "a number above 0")
    for group in ("loss", "optimizer"):
        for name, value in asdict(getattr(config, group)).items():
            if isinstance(value, int | float):
                _require(0 <= value < math.inf, config, group, name, "0 or more")


def _require(passed: bool, config: NeilfConfig, group: str, name: str, wanted: str) -> None:
    if not passed:
        option = f"--config.{group.replace('_', '-')}.{name.replace('_', '-')}"
        raise UserError(f"{option} is {getattr(getattr(config, group), name)}", f"set it to {wanted}")
