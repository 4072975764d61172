"""Sizes of a training step: factors on the numbers of rays, directions and fit points, and on network widths.

If a budget permits few steps of the usual size, smaller ones permit more of them; if it permits many, larger
steps learn more from each. The factors and thresholds are rules of thumb: it was not measured on which scenes
a smaller step is better.
"""

from __future__ import annotations

from collections.abc import Mapping
from functools import reduce
from typing import Literal

from neilfpp_method.settings.plain import changed
from neilfpp_method.settings.types import NeilfConfig

__all__ = ["Size", "next_size", "sized"]

Size = Literal["small", "usual", "large"]

FEW_STEPS_SHARE = 0.25
"""Share of the steps of the settings below which the small size is tried."""
MANY_STEPS_SHARE = 2.0
"""Share of the steps of the settings above which the large size is tried."""

FACTORS: Mapping[Size, Mapping[str, float]] = {
    "small": {
        "train.rays": 0.5,
        "shading.train_samples": 0.5,
        "radiance.width": 0.5,
        "light.fit.points": 0.5,
    },
    "usual": {},
    "large": {
        "train.rays": 2.0,
        "shading.train_samples": 2.0,
        "radiance.width": 2.0,
        "brdf.width": 2.0,
        "light.fit.points": 2.0,
    },
}


def sized(config: NeilfConfig, size: Size) -> NeilfConfig:
    """The settings with steps of this size.

    Factors on settings that do not exist, such as those of fits with the free light field, are ignored.

    >>> sized(NeilfConfig(), "small").train.rays
    2048
    """
    candidates = {
        name: factor
        for name, factor in FACTORS[size].items()
        if not name.startswith("light.fit.") or config.light.kind != "free"
    }
    values = {name: max(1, round(factor * _value(config, name))) for name, factor in candidates.items()}
    return changed(config, values)


def next_size(share: float) -> Size:
    """The size to try if the budget permits this share of the steps of the settings at the usual size.

    The large size should be used only if `share_for` is at least 1 for it.

    >>> [next_size(share) for share in (0.1, 0.25, 1.0, 2.5)]
    ['small', 'usual', 'usual', 'large']
    """
    return "small" if share < FEW_STEPS_SHARE else "large" if share > MANY_STEPS_SHARE else "usual"


def _value(config: NeilfConfig, name: str) -> int:
    """The value of a setting with a dotted name."""
    return reduce(getattr, name.split("."), config)
