"""Check a configuration before training: values out of range.

Settings that exclude each other cannot be written: each kind of light and of host has settings of its own.
Python does not check the types and choices of a dataclass, so they are checked here as those of a file are.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import asdict
from operator import attrgetter
from typing import Any

from neilfpp_method.errors import UserError
from neilfpp_method.settings.plain import from_dict, to_dict
from neilfpp_method.settings.types import NeilfConfig, VolSdfConfig

__all__ = ["check_config"]

COUNTS = ("train.rays", "train.checkpoint_every", "shading.train_samples", "shading.eval_samples")
"""Settings that are at least 1."""
INITIAL_VALUES = ("brdf.initial_base_color", "brdf.initial_metallic")
"""Settings between 0 and 1, without these bounds: the sigmoid of the field does not reach them."""
MIN_SAMPLES = 4
"""Smallest number of rendered samples per ray: both ends, the cut nearest to a surface, one by opacity."""
MAX_SEED = 2**32 - 1
"""Largest seed. The seed of a step is a multiple of it (`seed_step`) that must fit into 64 bits."""


def check_config(config: NeilfConfig) -> None:
    """Reject settings from which no model can be made, in every training loop.

    Raises:
        UserError: a value is out of range, has the wrong type, or is not one of the choices.
    """
    from_dict(NeilfConfig, to_dict(config))
    _check_ranges(config)
    if isinstance(config.host, VolSdfConfig):
        _check_recovered_geometry(config)


def _check_ranges(config: NeilfConfig) -> None:
    for name in COUNTS:
        _require(lambda count: count >= 1, config, name, "1 or more")
    _require(lambda seed: 0 <= seed <= MAX_SEED, config, "train.seed", f"0 to {MAX_SEED}")
    _require(lambda share: 0 <= share <= 1, config, "shading.hit_share", "0 to 1")
    for name in INITIAL_VALUES:
        _require(lambda value: 0 < value < 1, config, name, "a number above 0 and below 1")
    _require(_is_positive, config, "background.radius", "a number above 0")
    for group in ("loss", "optimizer"):
        _check_not_negative(config, group)
    _require(lambda final: min(final) > 0, config, "optimizer.final", "numbers above 0")


def _check_recovered_geometry(config: NeilfConfig) -> None:
    """The settings that only a host with a distance field has."""
    _require(lambda count: count >= MIN_SAMPLES, config, "host.volume.samples", f"{MIN_SAMPLES} or more")
    _require(_is_positive, config, "host.volume.beta_init", "a number above 0")
    _require(lambda bound: not bound < 0, config, "host.volume.beta_final", "0 (no bound) or more")
    _check_not_negative(config, "host.loss")


def _is_positive(value: float) -> bool:
    return 0 < value < math.inf


def _check_not_negative(config: NeilfConfig, group: str) -> None:
    """Check all numbers of a group, those in tuples too."""
    for name, value in asdict(attrgetter(group)(config)).items():
        if isinstance(value, tuple):
            _require(
                lambda numbers: all(0 <= number < math.inf for number in numbers),
                config,
                f"{group}.{name}",
                "numbers of 0 or more",
            )
        elif isinstance(value, int | float):
            _require(lambda number: 0 <= number < math.inf, config, f"{group}.{name}", "0 or more")


def _require(passes: Callable[[Any], bool], config: NeilfConfig, name: str, wanted: str) -> None:
    """Check the value of a setting with a dotted name."""
    value = attrgetter(name)(config)
    if not passes(value):
        raise UserError(f"--config.{name.replace('_', '-')} is {value}", f"set it to {wanted}")
