"""How large a step is: rays, directions, points of the light's fits, networks, as factors on the settings.

A size is taken for the steps that it leaves. With few steps for a time, smaller ones allow more of them; with
many, larger ones learn more from each. The factors and the thresholds are a rule of thumb: on which scenes a
smaller step pays was not measured.
"""

from __future__ import annotations

from collections.abc import Mapping
from functools import reduce
from typing import Literal

from neilfpp_method.settings.plain import changed
from neilfpp_method.settings.types import NeilfConfig

__all__ = ["Size", "next_size", "sized"]

Size = Literal["small", "usual", "large"]

FEW, MANY = 0.25, 2.0
"""Share of the steps of the settings below which a smaller size, and above which a larger one, is tried."""

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
    """The settings with steps of this size; what they do not have, as fits of a light that is free, is left
    out.

    >>> sized(NeilfConfig(), "small").train.rays
    2048
    """
    known = {
        name: factor
        for name, factor in FACTORS[size].items()
        if not name.startswith("light.fit.") or config.light.kind != "free"
    }
    values = {name: max(1, round(factor * _value(config, name))) for name, factor in known.items()}
    return changed(config, values)


def next_size(share: float) -> Size:
    """The size to try when steps of the usual size come to this share of those of the settings; a larger one
    is kept if `share_for` of it is 1 at least.

    >>> [next_size(share) for share in (0.1, 0.25, 1.0, 2.5)]
    ['small', 'usual', 'usual', 'large']
    """
    return "small" if share < FEW else "large" if share > MANY else "usual"


def _value(config: NeilfConfig, name: str) -> int:
    return reduce(getattr, name.split("."), config)
