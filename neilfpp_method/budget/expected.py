"""The accuracy to expect of a training with a part of the steps of the settings.

Trainings of `fast` with a tenth and three tenths of its steps were compared with whole ones (the table of
docs/budget.md). Other captures differ, but the loss tells whether a budget is worth its time.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

__all__ = ["MEASURED", "Loss", "described", "expected_loss"]


@dataclass(frozen=True)
class Loss:
    """What a training is worse by than one with all steps.

    Attributes:
        share: share of the steps.
        base_color: of base colour after one factor per channel, dB.
        roughness, metallic: dB.
        normals: degrees.
    """

    share: float
    base_color: float
    roughness: float
    metallic: float
    normals: float


MEASURED = (Loss(0.1, 7.2, 5.1, 7.5, 5.4), Loss(0.3, 3.2, 1.9, 3.7, 1.0), Loss(1.0, 0.0, 0.0, 0.0, 0.0))
"""Means of `tabletop_env` and `spot_city` with geometry recovered, one seed."""


def expected_loss(share: float) -> Loss:
    """Interpolate the measured losses over the logarithm of the share; beyond the ends they are constant.

    Args:
        share: share of the steps of the settings, above 0.
    """
    share = min(max(share, MEASURED[0].share), MEASURED[-1].share)
    above = next(index for index in range(1, len(MEASURED)) if share <= MEASURED[index].share)
    left, right = MEASURED[above - 1], MEASURED[above]
    part = math.log(share / left.share) / math.log(right.share / left.share)

    def blend(name: str) -> float:
        return (1.0 - part) * getattr(left, name) + part * getattr(right, name)

    return Loss(share, *(blend(name) for name in ("base_color", "roughness", "metallic", "normals")))


def described(share: float) -> str:
    """A clause for the console about the accuracy of a training with a share of the steps.

    Example:
        >>> described(1.0)
        'expected accuracy: that of all steps of the settings'
    """
    if share >= 1.0:
        return "expected accuracy: that of all steps of the settings"
    loss = expected_loss(share)
    return (
        f"expected accuracy with {share:.0%} of the steps of the settings, from two captures: base colour "
        f"{loss.base_color:.1f}, roughness {loss.roughness:.1f} and metallic {loss.metallic:.1f} dB, normals "
        f"{loss.normals:.1f}° worse than with all"
    )
